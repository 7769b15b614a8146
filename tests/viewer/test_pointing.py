"""Rays, planes and what lies near a place."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.field.samples import Samples
from app.viewer.pointing import camera_ray, kept_upright, plane_hit, supporting_walks, walk_residual_uT
from app.viewer.source import Walk

LOOKS_DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # x right, y of the picture towards -y of the world, z of the camera down


def test_the_middle_of_the_picture_is_straight_ahead():
    np.testing.assert_allclose(camera_ray(LOOKS_DOWN, 1.0, 1.6, 0.5, 0.5), [0, 0, -1], atol=1e-12)


@given(st.floats(0, 1), st.floats(0, 1), st.floats(0.3, 2.0), st.floats(0.4, 2.5), st.integers(0, 2**32 - 1))
def test_a_ray_projects_back_to_where_it_came_from(u, v, fov, aspect, seed):
    """The pinhole camera written out: a point on the ray is seen at u, v again."""
    q = np.random.default_rng(seed).normal(size=4)
    q /= np.linalg.norm(q)
    w, x, y, z = q
    R = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                  [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                  [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])  # fmt: skip
    seen = R.T @ camera_ray(q, fov, aspect, u, v)
    focal = 0.5 / np.tan(fov / 2)
    assert seen[2] > 0
    assert focal * seen[0] / seen[2] / aspect + 0.5 == pytest.approx(u, abs=1e-9)
    assert focal * seen[1] / seen[2] + 0.5 == pytest.approx(v, abs=1e-9)


def test_a_camera_that_looks_straight_down_keeps_its_side_up():
    position, target = kept_upright(LOOKS_DOWN, np.array([3.0, 4.0, 20.0]), np.array([3.0, 4.0, 0.0]))
    np.testing.assert_allclose(position, [3.0, 4.0 - 0.02, 20.0])  # from the south: y is up in the picture
    slanted = np.array([3.0, -9.0, 20.0])
    assert kept_upright(LOOKS_DOWN, slanted, target)[0] is slanted


def test_a_plane_is_hit_ahead_only():
    distance_m, point_m = plane_hit(np.array([1.0, 2.0, 10.0]), np.array([0.6, 0.0, -0.8]), 2.0)
    assert distance_m == pytest.approx(10.0)
    np.testing.assert_allclose(point_m, [7.0, 2.0, 2.0])
    assert plane_hit(np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), 2.0) is None
    assert plane_hit(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), 2.0) is None


def test_residuals_are_what_was_measured_less_the_map(grid_of, walk_of):
    grid, walk = grid_of(), walk_of("a")
    residual = walk_residual_uT(grid, walk)
    known = grid.at(walk.p_building_m).measured
    assert 0 < known.sum() <= len(known)
    np.testing.assert_allclose(residual[known], np.tile([0.5, 0.0, 0.0], (known.sum(), 1)), atol=1e-9)
    assert np.isnan(residual[~known]).all()


def test_a_walk_that_has_not_the_maps_components_has_no_residual(grid_of, walk_of):
    walk = walk_of("a")
    s = walk.samples
    norms = Walk("n", "n", Samples(s.t_s, s.p_building_m, np.linalg.norm(s.B_uT, axis=1, keepdims=True), "norm"))
    assert walk_residual_uT(grid_of(), norms) is None
    (support,) = supporting_walks(grid_of(), [norms], s.p_building_m[10])
    assert support.residual_uT is None


def test_supporting_walks_are_those_that_came_near_nearest_first(grid_of, walk_of):
    grid = grid_of()
    near, nearer, far = walk_of("near", offset_m=0.6), walk_of("nearer", offset_m=-0.2), walk_of("far", offset_m=4.0)
    place = np.array([104.0, 41.0, 1.2])
    found = supporting_walks(grid, [near, nearer, far], place)
    assert [s.name for s in found] == ["nearer", "near"]
    for support, walk in zip(found, (nearer, near), strict=True):
        away = np.linalg.norm(walk.p_building_m[:, :2] - place[:2], axis=1)
        assert support.nearest_m == pytest.approx(away.min())
        assert support.samples == (away <= 1.0).sum()
        assert support.residual_uT == pytest.approx((0.5, 0.0, 0.0), abs=1e-9)
