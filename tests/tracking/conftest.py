"""Floors of smooth random fields, and devices carried over them whose readings are the map's and noise."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.positioning.floors import SearchableFloor, prepare_floor
from app.tracking.step import Step

Array = NDArray[np.float64]
AMBIENT = np.array([18.0, 2.0, -43.0])
WHITE = ErrorStructure(0.0, 1e-6, 1.0, 1.0)


def make_grid(
    rng: np.random.Generator,
    shape: tuple[int, int] = (60, 60),
    resolution_m: float = 0.25,
    length_m: float = 1.5,
    height_m: float = 1.2,
    noise_sd_uT: float = 0.5,
    map_sd_uT: float = 0.1,
    structure: ErrorStructure = WHITE,
    measured: NDArray[np.bool_] | None = None,
) -> FieldGrid:
    """A vector map of 15 x 15 m: a smooth field of 5 uT about the Earth's."""
    field = np.stack([gaussian_filter(rng.normal(size=shape), length_m / resolution_m, mode="wrap") for _ in range(3)])
    mean = np.moveaxis(5.0 * field / field.std(axis=(1, 2), keepdims=True), 0, -1)[None] + AMBIENT
    known = np.ones((1, *shape), dtype=np.bool_) if measured is None else measured[None]
    gradient = np.stack([np.gradient(mean, resolution_m, axis=2), np.gradient(mean, resolution_m, axis=1)], axis=-1)
    return FieldGrid(
        components="vector", origin_m=(0.0, 0.0), resolution_m=resolution_m, heights_m=np.array([height_m]),
        mean_uT=np.where(known[..., None], mean, AMBIENT).astype(np.float32),
        sd_uT=np.where(known[..., None], map_sd_uT, 5.0 * np.ones(3)).astype(np.float32),
        gradient_uT_per_m=gradient.astype(np.float32), measured=known, ambient_uT=AMBIENT,
        prior_sd_uT=np.full(3, 5.0), noise_sd_uT=np.full(3, noise_sd_uT), error_structure=structure,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Carried:
    steps: list[Step]
    truth_m: Array
    yaw_rad: float


def carry(
    rng: np.random.Generator,
    grid: FieldGrid,
    path_m: Array,
    noise_uT: float = 0.5,
    offset_uT: Sequence[float] = (0.0, 0.0, 0.0),
    scale: float = 1.0,
    first: int = 0,
) -> Carried:
    """A device carried level along a path (n, 2) on the floor of a grid; it faces the way it goes, told as yaw."""
    n = len(path_m)
    way = np.gradient(path_m, axis=0)
    heading = np.unwrap(np.arctan2(way[:, 1], way[:, 0]))
    p = np.column_stack([path_m, np.full(n, grid.heights_m[0])])
    B = grid.at(p).mean_uT + noise_uT * rng.normal(size=(n, 3))
    yaw = float(heading[0])

    def turned(v: Array, angle: Array | float) -> Array:
        c, s = np.cos(angle), np.sin(angle)
        return np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]])

    B = turned(B, -yaw) + turned(np.tile(offset_uT, (n, 1)), heading - yaw)
    moved = scale * turned(np.column_stack([path_m - path_m[0], np.zeros(n)]), -yaw)
    steps = [Step(first + k, 0.1 * k, B[k], moved[k], yaw_rad=float(heading[k] - yaw)) for k in range(n)]
    return Carried(steps, p, yaw)


def wandering(rng: np.random.Generator, length_m: float, inside_m: float = 15.0, spacing_m: float = 0.12) -> Array:
    """(n, 2) a smooth path that stays a metre inside a square floor."""
    n = int(length_m / spacing_m)
    while True:
        course = rng.uniform(-np.pi, np.pi) + np.cumsum(gaussian_filter(rng.normal(size=n), 8.0)) * 0.35
        way = spacing_m * np.column_stack([np.cos(course), np.sin(course)])
        path = rng.uniform(3.0, inside_m - 3.0, 2) + np.cumsum(way, axis=0)
        if (path > 1.0).all() and (path < inside_m - 1.0).all():
            return np.asarray(path)


@pytest.fixture(scope="session")
def grid_of() -> Callable[..., FieldGrid]:
    return make_grid


@pytest.fixture(scope="session")
def floor_of() -> Callable[..., SearchableFloor]:
    def make(rng: np.random.Generator, floor_id: str = "ground", **about: object) -> SearchableFloor:
        return prepare_floor(floor_id, make_grid(rng, **about))  # type: ignore[arg-type]

    return make


@pytest.fixture(scope="session")
def carried_over() -> Callable[..., Carried]:
    return carry


@pytest.fixture(scope="session")
def path_of() -> Callable[..., Array]:
    return wandering
