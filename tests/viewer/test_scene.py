"""What is drawn, as arrays: where it lies, what is left out, and how much there may be."""

import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from app.viewer import scene
from app.viewer.layers import ColourScale, layer_values

SCALE = ColourScale(20.0, 80.0)


def test_a_surface_lies_where_its_cells_are(grid_of):
    grid = grid_of()
    origin = np.array([100.0, 40.0, 0.0])
    picture = scene.surface(grid, layer_values(grid, "norm"), SCALE, origin)
    ny, nx = grid.measured.shape[1:]
    assert picture.rgba.shape == (ny, nx, 4)
    left, bottom = (np.array(picture.centre_m[:2]) - np.array(picture.size_m) / 2).tolist()
    assert (left, bottom) == pytest.approx((-0.125, -0.125))  # half a cell before the first centre
    assert picture.size_m == pytest.approx((nx * 0.25, ny * 0.25))
    assert picture.centre_m[2] == pytest.approx(1.2)


def test_unmeasured_cells_are_transparent_and_measured_ones_have_the_legends_colour(grid_of):
    grid = grid_of()
    values = layer_values(grid, "norm")
    picture = scene.surface(grid, values, SCALE, np.zeros(3))
    np.testing.assert_array_equal(picture.rgba[..., 3] == 255, grid.measured[0])
    np.testing.assert_array_equal(picture.rgba[..., 3] == 0, ~grid.measured[0])
    np.testing.assert_array_equal(picture.rgba[grid.measured[0], :3], SCALE.rgb(values[grid.measured[0]]))


def test_large_floors_are_thinned_to_the_limits(grid_of):
    grid = grid_of(size_m=(240.0, 220.0))
    values = layer_values(grid, "norm")
    assert values.size > 800_000
    picture = scene.surface(grid, values, SCALE, np.zeros(3))
    assert picture.rgba.shape[0] * picture.rgba.shape[1] <= scene.MAX_POINTS
    assert picture.size_m == pytest.approx((240.0, 220.0), abs=1.0)
    arrows = scene.field_arrows(grid, np.zeros(3), 0.25)
    assert 5_000 < len(arrows.ends_m) <= scene.MAX_ARROWS
    assert arrows.spacing_m > 0.25


def test_a_map_without_any_measured_cell_draws_nothing(grid_of):
    grid = grid_of()
    grid.measured[:] = False
    picture = scene.surface(grid, layer_values(grid, "norm"), SCALE, np.zeros(3))
    assert not picture.rgba[..., 3].any()
    assert len(scene.field_arrows(grid, np.zeros(3), 1.0).ends_m) == 0
    assert scene.suggested_arrow_spacing_m([grid]) > 0
    assert scene.suggested_arrow_spacing_m([]) > 0


def test_arrows_point_along_the_field_and_stand_on_the_map(grid_of):
    grid = grid_of()
    origin = np.array([112.0, 47.0, 0.0])
    arrows = scene.field_arrows(grid, origin, 1.0)
    tail, tip = arrows.ends_m[:, 0].astype(float), arrows.ends_m[:, 1].astype(float)
    at = grid.at(np.column_stack([tail[:, :2] + origin[:2], np.full(len(tail), 1.2)]))
    direction = (tip - tail) / np.linalg.norm(tip - tail, axis=1, keepdims=True)
    expected = at.mean_uT / np.linalg.norm(at.mean_uT, axis=1, keepdims=True)
    np.testing.assert_allclose(direction, expected, atol=2e-5)
    np.testing.assert_allclose(arrows.magnitude_uT, np.linalg.norm(at.mean_uT, axis=1), rtol=1e-5)
    assert np.minimum(tail[:, 2], tip[:, 2]).min() == pytest.approx(1.24, abs=1e-5)
    assert arrows.ends_m.dtype == np.float32
    np.testing.assert_array_equal(grid.measured[0, ::4, ::4].sum(), len(arrows.ends_m))


def test_a_level_map_has_vertical_arrows_and_a_norm_map_none(grid_of):
    level = scene.field_arrows(grid_of("level"), np.zeros(3), 1.0)
    np.testing.assert_array_equal(level.ends_m[:, 0, :2], level.ends_m[:, 1, :2])
    assert (level.ends_m[:, 1, 2] < level.ends_m[:, 0, 2]).mean() > 0.9  # the fixture's field points down
    assert len(scene.field_arrows(grid_of("norm"), np.zeros(3), 1.0).ends_m) == 0


def test_far_from_the_frames_origin_nothing_is_lost(grid_of, walk_of):
    """Map projections put buildings at millions of metres, where single precision steps by half a metre."""
    near, far = grid_of(), grid_of(origin_m=(500_100.0, 4_000_040.0))
    drawn = [scene.field_arrows(grid, scene.local_origin_m([grid]), 1.0).ends_m.astype(float) for grid in (near, far)]
    np.testing.assert_allclose(drawn[0], drawn[1], atol=1e-6)


def test_walks_are_joined_within_but_not_between(walk_of):
    walks = [walk_of("a"), walk_of("b", offset_m=3.0)]
    segments, colours = scene.walk_segments(walks, np.zeros(3))
    assert segments.shape == (2 * 199, 2, 3)
    assert colours.shape == segments.shape
    assert np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).max() < 0.3
    assert not (colours[0] == colours[-1]).all()
    assert len(scene.walk_segments([], np.zeros(3))[0]) == 0


def test_walks_in_narrow_lanes_hide_the_field_and_a_few_do_not(grid_of, walk_of):
    grid = grid_of()
    assert not scene.walks_hide_the_field([walk_of("a"), walk_of("b")], [grid])
    assert scene.walks_hide_the_field([walk_of("a", offset_m=0.5 * k) for k in range(8)], [grid])
    assert not scene.walks_hide_the_field([walk_of("a")], [])


def test_an_outline_is_closed():
    ring = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
    segments = scene.ring_segments([ring], 2.0, np.array([1.0, 1.0, 0.0]))
    np.testing.assert_allclose(segments[:, 1], np.roll(segments[:, 0], -1, axis=0))
    np.testing.assert_allclose(segments[:, :, 2], 2.0)
    np.testing.assert_allclose(segments[0, 0], [-1.0, -1.0, 2.0])


@given(width=st.floats(20.0, 900.0), depth=st.floats(20.0, 900.0))
def test_ground_squares_are_round_numbers_some_dozen_across(grid_of, width, depth):
    grid = grid_of(size_m=(width, depth), resolution_m=10.0)
    x0, y0, _, x1, y1, _ = grid.bounds_m
    cell = scene.ground_cell_m([grid])
    mantissa = cell / 10.0 ** np.floor(np.log10(cell) + 1e-9)
    assert round(mantissa, 6) in (1.0, 2.0, 5.0)
    assert cell >= max(x1 - x0, y1 - y0) / 12.1


def test_floors_close_together_are_pulled_apart_and_one_floor_is_not(grid_of):
    assert scene.suggested_separation_m([grid_of()]) == 0.0
    near = scene.suggested_separation_m([grid_of(), grid_of(height_m=5.2)])
    assert near > 5.0
    assert scene.suggested_separation_m([grid_of(), grid_of(height_m=101.2)]) == 0.0


def test_the_camera_looks_at_the_map_from_the_south_or_from_above(grid_of):
    grid = grid_of()
    origin = scene.local_origin_m([grid])
    position, target = scene.camera_pose([grid], origin)
    np.testing.assert_allclose(target, [0.0, 0.0, 1.2])
    assert position[1] < -5.0
    assert position[2] > 5.0
    above, _ = scene.camera_pose([grid], origin, top=True)
    np.testing.assert_allclose(above[:2], 0.0, atol=0.01)
    assert np.isfinite(scene.camera_pose([], np.zeros(3))).all()


def test_arrows_in_a_box_are_those_of_the_whole_floor_that_lie_in_it(grid_of):
    grid, origin, box = grid_of(), np.zeros(3), (104.0, 41.0, 110.0, 45.0)
    everywhere, inside = (
        scene.field_arrows(grid, origin, 1.0).ends_m,
        scene.field_arrows(grid, origin, 1.0, 0, box).ends_m,
    )
    x, y = everywhere[:, 0, 0], everywhere[:, 0, 1]
    expected = everywhere[(x >= 104.0) & (x <= 110.0) & (y >= 41.0) & (y <= 45.0)]
    assert 0 < len(expected) < len(everywhere)
    assert {tuple(tail) for tail in inside[:, 0, :2].tolist()} == {tuple(tail) for tail in expected[:, 0, :2].tolist()}


@given(st.floats(2.0, 400.0), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_arrows_stand_closer_the_nearer_the_camera_and_fill_what_is_looked_at(distance_m, x, y):
    target = np.array([x, y, 1.0])
    spacing_m, box = scene.arrow_view(np.array([x, y, 1.0 + distance_m]), target, 0.25)
    assert spacing_m == 0.25 * 2 ** round(np.log2(spacing_m / 0.25))  # steps of two: small moves change nothing
    assert 0.25 <= spacing_m <= max(0.25, distance_m / 16.0)
    half = 48.0 * spacing_m
    assert box[0] <= x - half / 2 <= x + half / 2 <= box[2]
    assert box[1] <= y - half / 2 <= y + half / 2 <= box[3]
    assert (box[2] - box[0]) / spacing_m <= 97  # so that there are never many thousands


def test_a_plan_is_opaque_and_its_transparent_places_are_paper():
    picture = np.zeros((30, 3000, 4), np.uint8)
    picture[:, :1500] = (10, 20, 30, 255)
    data = io.BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    plan = scene.plan_picture(data.getvalue())
    assert plan.shape == (20, 2048, 3)
    assert tuple(plan[10, 10]) == (10, 20, 30)
    assert tuple(plan[10, -10]) == (255, 255, 255)


def test_a_narrow_picture_is_looked_at_from_farther_away(grid_of):
    grid = grid_of()
    wide, narrow = (
        scene.camera_pose([grid], np.zeros(3), top, 0.0, aspect)[0] for top, aspect in ((True, 1.6), (True, 0.5))
    )
    assert narrow[2] > 2.0 * wide[2]
    wide, narrow = (scene.camera_pose([grid], np.zeros(3), False, 0.0, aspect)[0] for aspect in (1.6, 0.5))
    assert narrow[2] > 1.5 * wide[2]


def test_walks_take_the_colours_they_are_given(walk_of):
    walk = walk_of("a")
    colours = np.arange(200 * 3, dtype=np.uint8).reshape(200, 3)
    _, drawn = scene.walk_segments([walk], np.zeros(3), [colours])
    np.testing.assert_array_equal(drawn[:, 0], colours[:-1])
    np.testing.assert_array_equal(drawn[:, 1], colours[1:])
