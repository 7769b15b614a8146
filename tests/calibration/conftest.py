"""Records of sensors that are known, in fields that are known."""

from collections.abc import Callable

import numpy as np
import pytest

from app.geometry import Array

H_UT, Z_UT = 20.10995, 49.3  # the horizontal and the vertical field of (Shockley, L856)


def directions(rng: np.random.Generator, n: int) -> Array:
    """(n, 3) all over the sphere."""
    v = rng.normal(size=(n, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def circle(correction: Array, hard_iron_uT: Array, n: int = 2500, turns: float = 3.0) -> Array:
    """(n, 3) readings, without noise, of a sensor that is turned level: A_h (x - b_h) is the circle of H_UT."""
    angle = np.linspace(0.0, 2 * np.pi * turns, n, endpoint=False)
    true = H_UT * np.column_stack([np.cos(angle), -np.sin(angle)])
    return np.column_stack([true @ np.linalg.inv(correction).T + hard_iron_uT, np.full(n, Z_UT)])


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


@pytest.fixture
def sphere() -> Callable[..., Array]:
    def make(
        rng: np.random.Generator, distortion: Array, b: Array, field_uT: float, noise_uT: float, n: int = 1000
    ) -> Array:
        return field_uT * directions(rng, n) @ distortion.T + b + noise_uT * rng.normal(size=(n, 3))

    return make
