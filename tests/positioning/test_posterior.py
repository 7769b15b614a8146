"""Modes, atoms and radii against samples drawn from the same mixtures."""

import numpy as np
import pytest

from app.positioning.posterior import (
    Atoms,
    NarrowMode,
    cell_atoms,
    distinct_poses,
    mass_radius,
    mixture_points,
    replace_narrow_modes,
    untold_variance_m2,
)


def atoms_of(position: list, mass: list, sd: float) -> Atoms:
    n = len(mass)
    spread = np.repeat(sd**2 * np.eye(2)[None], n, axis=0)
    return Atoms(np.zeros(n, dtype=np.int64), np.array(position, dtype=float), np.array(mass, dtype=float), spread)


def test_radii_of_a_gaussian_are_those_of_rayleigh() -> None:
    points, mass = mixture_points(atoms_of([[1.0, 2.0]], [1.0], 0.5))
    radii = mass_radius(points, mass, np.array([1.0, 2.0]), (0.5, 0.68, 0.95))
    expected = 0.5 * np.sqrt(-2 * np.log([0.5, 0.32, 0.05]))
    np.testing.assert_allclose(radii, expected, rtol=0.06)


def test_radii_of_a_mixture_agree_with_sampling() -> None:
    rng = np.random.default_rng(0)
    atoms = atoms_of([[0, 0], [3, 0], [0, 8]], [0.7, 0.2, 0.1], 0.4)
    points, mass = mixture_points(atoms)
    assert mass.sum() == pytest.approx(1.0)
    which = rng.choice(3, size=100_000, p=atoms.mass)
    drawn = atoms.position_m[which] + 0.4 * rng.normal(size=(100_000, 2))
    radii = mass_radius(points, mass, np.zeros(2), (0.5, 0.68, 0.85, 0.95))
    held = [np.mean(np.linalg.norm(drawn, axis=1) <= r) for r in radii]
    np.testing.assert_allclose(held, [0.5, 0.68, 0.85, 0.95], atol=0.02)
    assert list(radii) == sorted(radii)


def test_atoms_sum_headings_of_a_cell() -> None:
    plane, row, column = np.array([0, 0, 1]), np.array([2, 2, 2]), np.array([3, 3, 3])
    position = np.array([[1.0, 1.0], [1.0, 1.0], [1.0, 1.0]])
    atoms = cell_atoms(plane, row, column, position, np.array([0.2, 0.3, 0.5]), np.full(3, 0.6), 0.01)
    np.testing.assert_allclose(atoms.mass, [0.5, 0.5])
    np.testing.assert_allclose(atoms.covariance_m2[0], (0.6**2 / 12 + 0.01) * np.eye(2))


def test_starts_are_apart_in_place_or_heading_and_the_best_of_theirs() -> None:
    position = np.array([[0.0, 0], [1, 0], [10, 0], [10.5, 0], [0, 0], [10.2, 0]])
    plane, heading = np.array([0, 0, 0, 0, 1, 0]), np.array([0.0, 0.1, 0.0, 6.2, 0.0, 3.0])
    assert distinct_poses(plane, position, heading, 2.0, 0.35, 8).tolist() == [0, 2, 4, 5]
    assert distinct_poses(plane, position, heading, 2.0, 0.35, 2).tolist() == [0, 2]


def test_only_modes_narrower_than_a_cell_are_replaced() -> None:
    atoms = atoms_of([[0, 0], [0.25, 0], [9, 0]], [0.4, 0.3, 0.3], 0.1)
    centre = np.array([0.1, 0.0])
    wide = NarrowMode(0, centre, 0.3**2 * np.eye(2), 5.0, 0.25)
    assert replace_narrow_modes(atoms, [wide], 0.0) is atoms
    narrow = NarrowMode(0, centre, 0.05**2 * np.eye(2), 0.9, 0.25)
    fine = replace_narrow_modes(atoms, [wide, narrow], 0.0009)
    np.testing.assert_allclose(fine.mass, [0.3, 0.9])
    np.testing.assert_allclose(fine.covariance_m2[1], (0.05**2 + 0.0009) * np.eye(2))


def test_what_a_fit_leaves_of_a_random_walk_at_its_end() -> None:
    """Place, trend (heading and scale) fitted out of a random walk: the variance left at its end, by simulation."""
    rng, n, length_m = np.random.default_rng(0), 400, 20.0
    path = np.linspace(0.0, length_m, n)
    walks = np.cumsum(rng.normal(0.0, 0.024 * np.sqrt(length_m / n), (4000, n)), axis=1)
    design = np.column_stack([np.ones(n), path])
    left = walks - walks @ design @ np.linalg.solve(design.T @ design, design.T)
    assert untold_variance_m2(path) - untold_variance_m2(path[:1]) == pytest.approx(left[:, -1].var(), rel=0.1)
    assert untold_variance_m2(path[:1]) > 0.0
