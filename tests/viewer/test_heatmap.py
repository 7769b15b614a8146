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
    with pytest.raises(InvalidInput, match="norm, sd, gradient, measured"):
        heatmap_png(grid_of("norm"), "bz")


@pytest.mark.parametrize("size_m", [(3.0, 120.0), (120.0, 3.0)])
def test_long_corridors_give_pictures_of_bounded_size(grid_of, size_m):
    ny, nx, _ = imread(io.BytesIO(heatmap_png(grid_of(size_m=size_m)))).shape
    assert max(nx, ny) <= 1200
    assert min(nx, ny) >= 300


def _coloured_share(png: bytes) -> float:
    rgb = imread(io.BytesIO(png))[..., :3]
    return float((np.ptp(rgb, axis=-1) > 0.1).mean())
