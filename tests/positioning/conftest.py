"""Small worlds to be lost in: smooth random fields on grids, walks through them, and the naive exhaustive search."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components
from app.positioning.window import Window

AMBIENT = {
    "vector": np.array([18.0, 2.0, -43.0]),
    "level": np.array([18.0, -43.0]),
    "norm": np.array([46.7]),
}
Array = NDArray[np.float64]
WHITE = ErrorStructure(0.0, 0.0, 1.0, 1.0)


def make_grid(
    rng: np.random.Generator,
    shape: tuple[int, int] = (40, 40),
    components: Components = "vector",
    resolution_m: float = 0.25,
    field_sd_uT: float = 5.0,
    length_m: float = 1.5,
    map_sd_uT: float = 0.3,
    noise_sd_uT: float = 0.4,
    origin_m: tuple[float, float] = (-3.0, 7.0),
    heights_m: tuple[float, ...] = (1.2,),
    unmapped: float = 0.0,
    error_correlation_m: float = 0.0,
    sd_spread: float = 0.3,
) -> FieldGrid:
    """A smooth random field; `unmapped` is the share of cells (in patches) that were never measured."""
    c, nz = len(COMPONENT_NAMES[components]), len(heights_m)
    sigma = length_m / resolution_m
    field = np.stack(
        [[gaussian_filter(rng.normal(size=shape), sigma, mode="wrap") for _ in range(c)] for _ in range(nz)], axis=0
    )
    field = np.moveaxis(field, 1, -1)
    field *= field_sd_uT / np.maximum(field.std(axis=(1, 2), keepdims=True), 0.01)
    mean = field + AMBIENT[components]
    gradient = np.stack([np.gradient(mean, resolution_m, axis=2), np.gradient(mean, resolution_m, axis=1)], axis=-1)
    patches = gaussian_filter(rng.normal(size=(nz, *shape)), (0, 4, 4), mode="wrap")
    measured = patches >= (np.quantile(patches, unmapped) if unmapped else -np.inf)
    prior_sd = np.full(c, max(field_sd_uT, 1.0))
    sd = map_sd_uT * (1.0 + sd_spread * rng.random((nz, *shape, c)))
    return FieldGrid(
        components=components,
        origin_m=origin_m,
        resolution_m=resolution_m,
        heights_m=np.array(heights_m),
        mean_uT=np.where(measured[..., None], mean, AMBIENT[components]).astype(np.float32),
        sd_uT=np.where(measured[..., None], sd, prior_sd).astype(np.float32),
        gradient_uT_per_m=np.where(measured[..., None, None], gradient, 0.0).astype(np.float32),
        measured=measured,
        ambient_uT=AMBIENT[components],
        prior_sd_uT=prior_sd,
        noise_sd_uT=np.full(c, noise_sd_uT),
        error_correlation_m=error_correlation_m,
        error_structure=WHITE,
    )


@dataclass(frozen=True, slots=True)
class Walked:
    """A window and where it truly was: position and heading of the device at the last sample, yaw of the frame."""

    window: Window
    position_m: Array
    heading_rad: float
    yaw_rad: float


def make_walk(
    rng: np.random.Generator,
    grid: FieldGrid,
    frame: str = "level",
    length_m: float = 3.0,
    samples: int = 8,
    noise_uT: float = 0.4,
    offset_uT: float = 0.0,
    layer: int = 0,
    inside: bool = True,
) -> Walked:
    """A gently turning walk over a grid of vectors (or of what the frame needs), its device facing along the path."""
    x0, y0, _, x1, y1, _ = grid.bounds_m
    step = length_m / max(samples - 1, 1)
    for _ in range(10_000):
        yaw = rng.uniform(-np.pi, np.pi)
        course = yaw + np.cumsum(rng.normal(0.0, 0.08, samples))
        course[:1] = yaw
        steps = step * np.stack([np.cos(course), np.sin(course)], axis=1)
        steps[0] = 0.0
        p = rng.uniform((x0, y0), (x1, y1)) + np.cumsum(steps, axis=0)
        if not inside or ((p >= (x0, y0)).all() and (p <= (x1, y1)).all()):
            break
    points = np.column_stack([p, np.full(samples, grid.heights_m[layer])])
    truth = grid.at(points).mean_uT
    B = truth + rng.normal(0.0, 1.0, truth.shape) * np.maximum(noise_uT, grid.noise_sd_uT)
    d = np.column_stack([p - p[0], np.zeros(samples)])
    if frame != "building":
        c, s = np.cos(yaw), np.sin(yaw)
        back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        d = d @ back.T
        B = B @ back.T if B.shape[1] == 3 else B
    if B.shape[1] == 3 and offset_uT:  # constant in the device's axes, which turn with the course
        turned = course - (yaw if frame != "building" else 0.0)
        B = B + offset_uT * np.column_stack(
            [np.cos(turned) - np.sin(turned), np.sin(turned) + np.cos(turned), turned**0]
        )
    if frame == "norm" and B.shape[1] > 1:
        B = np.linalg.norm(B, axis=1, keepdims=True)
    window = Window(frame, B, d, noise_uT, yaw_rad=course - yaw)  # type: ignore[arg-type]
    return Walked(window, p[-1], float(course[-1]), float(yaw))


@pytest.fixture
def grid_of() -> Callable[..., FieldGrid]:
    return make_grid


@pytest.fixture
def walk_on() -> Callable[..., Walked]:
    return make_walk
