"""A room of random dipoles below the floor and above the ceiling: curl- and divergence-free where one walks."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from app.field.samples import Samples

Array = NDArray[np.float64]
AMBIENT_UT = np.array([18.0, 3.0, -44.0])


@dataclass(frozen=True)
class Room:
    """A room of `width_m` x `depth_m` walked at height 0 whose field is known everywhere."""

    width_m: float
    depth_m: float
    dipole_position_m: Array
    dipole_moment: Array

    @classmethod
    def random(cls, rng: np.random.Generator, width_m: float = 12.0, depth_m: float = 9.0) -> "Room":
        count = int(0.12 * (width_m + 10) * (depth_m + 10))
        xy = rng.uniform([-5.0, -5.0], [width_m + 5.0, depth_m + 5.0], (count, 2))
        below = rng.random(count) < 0.5
        z = np.where(below, rng.uniform(-2.7, -1.5, count), rng.uniform(1.6, 2.8, count))
        moment = rng.normal(size=(count, 3)) * rng.gamma(1.0, 12.0, size=(count, 1))
        return cls(width_m, depth_m, np.column_stack([xy, z]), moment)

    def field_uT(self, points_m: Array) -> Array:
        """(n, 3) field at points (n, 3)."""
        r = points_m[:, None, :] - self.dipole_position_m[None]
        distance = np.linalg.norm(r, axis=-1, keepdims=True)
        along = np.sum(r * self.dipole_moment, axis=-1, keepdims=True)
        return np.sum(3.0 * r * along / distance**5 - self.dipole_moment / distance**3, axis=1) + AMBIENT_UT

    def walk(self, rng: np.random.Generator, path_m: Array, noise_uT: float = 0.3, spacing_m: float = 0.1) -> Samples:
        """Samples every `spacing_m` along a polyline (k, 2)."""
        legs = np.linalg.norm(np.diff(path_m, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(legs)])
        s = np.arange(0.0, along[-1], spacing_m)
        p = np.column_stack([np.interp(s, along, path_m[:, 0]), np.interp(s, along, path_m[:, 1]), np.zeros(len(s))])
        B = self.field_uT(p) + noise_uT * rng.normal(size=p.shape)
        return Samples(np.arange(len(s)) * 0.1, p, B, "building")

    def lanes(
        self, rng: np.random.Generator, surveys: int = 4, lane_m: float = 1.0, noise_uT: float = 0.3
    ) -> dict[str, Samples]:
        """Lawnmower walks, alternately along x and along y, shifted against each other."""
        return {
            f"survey-{index}": self.walk(rng, self._lawnmower(index, surveys, lane_m), noise_uT)
            for index in range(surveys)
        }

    def _lawnmower(self, index: int, surveys: int, lane_m: float) -> Array:
        first = lane_m * (0.2 + 0.6 * index / surveys)
        long, wide = (self.width_m, self.depth_m) if index % 2 == 0 else (self.depth_m, self.width_m)
        corners = []
        for lane, offset in enumerate(np.arange(first, wide, lane_m)):
            ends = [(0.0, offset), (long, offset)]
            corners += ends if lane % 2 == 0 else ends[::-1]
        path = np.array(corners)
        return path if index % 2 == 0 else path[:, ::-1]


@pytest.fixture(scope="session")
def make_room() -> Callable[[int], Room]:
    return lambda seed: Room.random(np.random.default_rng(seed))


@pytest.fixture
def room(make_room) -> Room:
    return make_room(7)


@pytest.fixture(autouse=True, scope="session")
def _one_blas_thread():
    """Threads only slow small matrices down, badly so on a busy machine."""
    with threadpool_limits(1):
        yield
