"""Heat maps: pictures of the right kind, the same every time, with a reason when there is none."""

import io
from threading import Thread

import numpy as np
import pytest
from matplotlib.image import imread

from app.errors import InvalidInput
from app.viewer.heatmap import heatmap_png
from app.viewer.layers import layer_names


def test_every_layer_of_a_map_has_a_picture(grid_of):
    pictures = {heatmap_png(grid_of("level"), layer) for layer in layer_names("level")}
    assert len(pictures) == len(layer_names("level"))
    assert all(p.startswith(b"\x89PNG\r\n\x1a\n") and p.endswith(b"IEND\xaeB`\x82") for p in pictures)


def test_the_same_map_gives_the_same_bytes_also_in_another_thread(grid_of):
    first = heatmap_png(grid_of(), "norm", "Ground")
    again: list[bytes] = []
    threads = [Thread(target=lambda: again.append(heatmap_png(grid_of(), "norm", "Ground"))) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert again == [first, first]
    assert heatmap_png(grid_of(), "norm", "First") != first


def test_unmeasured_cells_are_blank(grid_of):
    grid = grid_of()
    coloured = _coloured_share(heatmap_png(grid, "norm"))
    grid.measured[:] = False
    blank = _coloured_share(heatmap_png(grid, "norm"))
    assert coloured > 0.25
    assert blank < 0.06  # the colour bar


def test_a_layer_it_does_not_have_is_named_with_those_it_has(grid_of):
    with pytest.raises(InvalidInput, match=r"norm, sd, gradient, .*, measured"):
        heatmap_png(grid_of("norm"), "bz")


@pytest.mark.parametrize("size_m", [(3.0, 120.0), (120.0, 3.0)])
def test_long_corridors_give_pictures_of_bounded_size(grid_of, size_m):
    ny, nx, _ = imread(io.BytesIO(heatmap_png(grid_of(size_m=size_m)))).shape
    assert max(nx, ny) <= 1200
    assert min(nx, ny) >= 300


@pytest.mark.parametrize(("size_m", "bar_m"), [((24.0, 14.0), 2.0), ((4.0, 9.75), 2.0), ((240.0, 120.0), 20.0)])
def test_the_scale_bar_is_as_long_as_it_says(grid_of, size_m, bar_m):
    """Against the frame of the plot, whose width in metres is known: one cell more than its centres are apart."""
    grid = grid_of(size_m=size_m, resolution_m=0.5)
    dark = imread(io.BytesIO(heatmap_png(grid, "norm")))[..., :3].max(axis=-1) < 0.35
    runs = np.array([_longest_run(row) for row in dark])
    frame_px = runs[: _last_above(runs, 0.9 * runs.max()) + 1].max()
    bar_px = runs[_last_above(runs, 0.9 * runs.max()) + 5 :].max()
    assert bar_px / frame_px == pytest.approx(bar_m / (size_m[0] + 0.5), abs=4.0 / frame_px)


def test_a_stored_layer_is_drawn_with_grey_where_it_knows_nothing(grid_of):
    grid = grid_of(heights=2)
    conflict = np.ones(grid.measured.shape, np.float32)
    conflict[1, :, :40] = np.nan
    pictures = [heatmap_png(grid, "conflict", height_index=k, stored={"conflict": conflict}) for k in (0, 1)]
    grey = [(np.abs(imread(io.BytesIO(p))[..., :3] - 0xD0 / 255).max(axis=-1) < 0.01).mean() for p in pictures]
    assert grey[0] < 0.001
    assert grey[1] > 0.1


def test_the_colour_bar_is_as_tall_as_the_map(grid_of):
    rgb = imread(io.BytesIO(heatmap_png(grid_of(size_m=(24.0, 14.0)), "norm")))[..., :3]
    coloured = np.ptp(rgb, axis=-1) > 0.1
    rows = [np.flatnonzero(part.any(axis=1))[[0, -1]] for part in (coloured[:, :720], coloured[:, 760:])]
    np.testing.assert_allclose(rows[0], rows[1], atol=4)


def test_surveys_are_counted_in_whole_steps(grid_of):
    """The bar has a colour per number of surveys, and none between."""
    grid = grid_of()
    coverage = np.broadcast_to(1.0 + np.arange(grid.measured.shape[2]) % 4, grid.measured.shape)
    png = heatmap_png(grid, "coverage", stored={"coverage": coverage.astype(np.float32)})
    bar = np.round(imread(io.BytesIO(png))[:, 760:, :3] * 32).reshape(-1, 3)
    colours, counts = np.unique(bar, axis=0, return_counts=True)
    assert (counts[np.ptp(colours, axis=1) > 0] > 1500).sum() == 4


def _longest_run(row) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def _last_above(values, threshold) -> int:
    return int(np.flatnonzero(values >= threshold)[-1])


def _coloured_share(png: bytes) -> float:
    rgb = imread(io.BytesIO(png))[..., :3]
    return float((np.ptp(rgb, axis=-1) > 0.1).mean())
