import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from app.field.tiles import Lattice, Tile

COORDINATES = st.floats(-200.0, 200.0, allow_nan=False)
Lattice(4.0).weight(0, next(iter(Lattice(4.0).answering(np.zeros((1, 2))))), np.zeros(1))  # compiles, before any clock


@given(x=COORDINATES, y=COORDINATES, pitch=st.sampled_from([1.5, 4.0, 16.0]))
def test_weights_sum_to_one_everywhere(x, y, pitch):
    lattice, point = Lattice(pitch), np.array([[x, y]])
    total = sum(
        lattice.weight(0, tile, point[:, 0]) * lattice.weight(1, tile, point[:, 1]) for tile in lattice.answering(point)
    )
    assert np.allclose(total, 1.0, atol=1e-12)


@given(x=COORDINATES)
def test_weight_slope_is_the_derivative_of_the_weight(x):
    lattice, at, h = Lattice(8.0), np.array([x]), 1e-5
    tile = Tile(int(np.floor(x / 8.0)), 0)
    numeric = (lattice.weight(0, tile, at + h) - lattice.weight(0, tile, at - h)) / (2 * h)
    assert np.allclose(lattice.weights(0, tile, at)[1], numeric, atol=1e-5)


def test_a_tile_is_fitted_from_every_point_it_answers_and_more():
    lattice = Lattice(4.0)
    points = np.random.default_rng(0).uniform(-9.0, 9.0, (400, 2))
    fitting = lattice.fitting(points)
    for tile, answered in lattice.answering(points).items():
        assert set(answered) <= set(fitting[tile])
    for tile, inside in fitting.items():
        basis = lattice.basis(tile)
        assert np.all(points[inside] >= np.array(basis.corner_m) - 1e-9)
        assert np.all(points[inside] <= np.array(basis.corner_m) + basis.side_m + 1e-9)


def test_tiles_do_not_depend_on_the_other_points():
    lattice = Lattice(4.0)
    points = np.random.default_rng(0).uniform(-9.0, 9.0, (100, 2))
    alone = {tile for p in points[:10] for tile in lattice.fitting(p[None])}
    assert alone <= set(lattice.fitting(points))


def test_points_far_apart_are_grouped_as_those_side_by_side():
    points = np.random.default_rng(1).uniform(-9.0, 9.0, (200, 2))
    far = np.vstack([points, [[4e7, -3e7]]])
    together, alone = Lattice(4.0).fitting(far), Lattice(4.0).fitting(points)
    assert list(together) == sorted(together)
    assert {tile: inside.tolist() for tile, inside in together.items() if 200 not in inside} == {
        tile: inside.tolist() for tile, inside in alone.items()
    }
    assert Lattice(4.0).fitting(np.zeros((0, 2))) == {}


def test_a_point_as_far_from_both_neighbours_belongs_to_all_of_them():
    assert len(Lattice(4.0, margin=0.5).fitting(np.full((1, 2), 2.0))) == 9
