import magpylib
import numpy as np
import pytest

from app.synthetic import Bars, Cuboids, Dipoles

POINTS_M = np.random.default_rng(1).uniform([-5.0, -5.0, 3.0], [5.0, 5.0, 13.0], size=(5000, 3))


def test_dipole_is_the_textbook_formula() -> None:
    m = np.array([1.0, -2.0, 0.5])
    r = POINTS_M[:100] - [1.0, 2.0, 0.0]
    d = np.linalg.norm(r, axis=1, keepdims=True)
    expected = 3.0 * r * (r @ m)[:, None] / d**5 - m / d**3
    found = Dipoles(np.array([[1.0, 2.0, 0.0]]), m[None]).field_uT(POINTS_M[:100])
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-14)


def test_dipoles_equal_magpylib(rng: np.random.Generator) -> None:
    position, moment_A_m2 = rng.normal(size=(20, 3)), rng.normal(size=(20, 3)) * 50.0
    sources = [magpylib.misc.Dipole(position=p, moment=m) for p, m in zip(position, moment_A_m2, strict=True)]
    expected_uT = magpylib.getB(sources, POINTS_M, sumup=True) * 1e6
    np.testing.assert_allclose(Dipoles(position, 0.1 * moment_A_m2).field_uT(POINTS_M), expected_uT, rtol=1e-6)


def test_bars_equal_thin_cuboids_of_magpylib(rng: np.random.Generator) -> None:
    start, end = np.array([[0.0, 0.0, 0.0]]), np.array([[0.0, 0.0, 2.0]])
    side_m, polarisation_uT = 0.01, 2e6
    thin = magpylib.magnet.Cuboid(
        position=(0, 0, 1), dimension=(side_m, side_m, 2), polarization=(0, 0, polarisation_uT * 1e-6)
    )
    strength = np.array([polarisation_uT * side_m**2 / (4 * np.pi)])
    expected_uT = magpylib.getB(thin, POINTS_M) * 1e6
    np.testing.assert_allclose(
        Bars(start, end, strength).field_uT(POINTS_M), expected_uT, atol=1e-4 * np.abs(expected_uT).max()
    )


def test_cuboids_equal_magpylib_and_add_up(rng: np.random.Generator) -> None:
    position, size, polarisation = rng.normal(size=(3, 3)), rng.uniform(0.2, 1.0, (3, 3)), rng.normal(size=(3, 3))
    sources = [
        magpylib.magnet.Cuboid(position=p, dimension=s, polarization=j)
        for p, s, j in zip(position, size, polarisation, strict=True)
    ]
    found = Cuboids(position, size, polarisation).field_uT(POINTS_M)
    np.testing.assert_allclose(found, magpylib.getB(sources, POINTS_M, sumup=True), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(
    "steel",
    [
        Dipoles(np.eye(3), np.eye(3) + 1.0),
        Bars(np.eye(3), -np.eye(3), np.array([1.0, 2.0, -1.0])),
        Cuboids(np.eye(3), np.full((3, 3), 0.5), np.eye(3) - 0.3),
    ],
)
def test_superposition_and_scaling(steel: Dipoles | Bars | Cuboids) -> None:
    whole = steel.field_uT(POINTS_M)
    np.testing.assert_allclose(steel.scaled(3.0).field_uT(POINTS_M), 3.0 * whole, rtol=1e-9, atol=1e-15)
    n = len(steel.position_m)
    parts = sum(steel.scaled(one).field_uT(POINTS_M) for one in _each_on_its_own(steel, n))
    np.testing.assert_allclose(parts, whole, rtol=1e-9, atol=1e-15)


def _each_on_its_own(steel: Dipoles | Bars | Cuboids, n: int) -> np.ndarray:
    bars = n // 2 if isinstance(steel, Bars) else n
    one = np.eye(bars)
    return np.hstack([one, one]) if isinstance(steel, Bars) else one


def test_a_bar_is_as_weak_as_its_weaker_pole() -> None:
    bar = Bars(np.zeros((2, 3)), np.ones((2, 3)), np.array([2.0, 4.0]))
    np.testing.assert_allclose(bar.scaled(np.array([1.0, 0.5, 0.25, 1.0])).strength_uT_m2, [0.5, 2.0])
