"""The cloud of particles that one compiled step works on, and what the step is told: see `app.tracking.fused_step`."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.field.grid import FieldGrid
from app.geometry import Array
from app.tracking.motion import Displacement
from app.tracking.random_numbers import Float32

__all__ = [
    "EXACTLY", "UNMAPPED_UT2", "CellTable", "Cloud", "Moments", "Step", "Stepped", "cell_table", "moments_of",
]  # fmt: skip

EXACTLY = 1.0 - 1e-6
"""Equal weights are as many as they are, whatever rounding says."""
UNMAPPED_UT2 = np.float32(1e15)
"""A variance above this has an unmeasured cell in it."""
_UNMEASURED_UT2 = np.float32(1e30)


class CellTable(NamedTuple):
    """record (ny, nx, 4): bx, by, bz (uT) and their mean variance (uT^2), which is 1e30 where nobody measured."""

    record: Float32
    x0_m: np.float32
    y0_m: np.float32
    cells_per_m: np.float32


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """state (5, n): x, y (m), cos and sin of the heading, scale; weight (n,) with sum one."""

    state: Float32
    weight: Float32

    @classmethod
    def of(cls, position_m: Array, heading_rad: Array, scale: Array) -> "Cloud":
        """Equal weights at positions (n, 2), headings (n,) and scales (n,)."""
        rows = [*position_m.T, np.cos(heading_rad), np.sin(heading_rad), scale]
        state = np.ascontiguousarray(rows, dtype=np.float32)
        return cls(state, np.full(state.shape[1], 1.0 / state.shape[1], dtype=np.float32))

    def __len__(self) -> int:
        return int(self.state.shape[1])


class Step(NamedTuple):
    """What a step is told: displacement (2,) m and reading (3,) uT in the teller's level frame, and their noise."""

    displacement_m: tuple[float, float]
    reading_uT: tuple[float, float, float]
    sensor_variance_uT2: float
    motion: Displacement
    elapsed_s: float = 0.0

    def numbers(self) -> Float32:
        """(10,) dx, dy, sds of position, heading and scale, the reading, the variance."""
        length_m = float(np.hypot(*self.displacement_m))
        sds = self.motion.sds(length_m, self.elapsed_s)
        return np.array([*self.displacement_m, *sds, *self.reading_uT, self.sensor_variance_uT2], dtype=np.float32)


class Moments(NamedTuple):
    """Weighted mean (5,) of the rows of the state, and covariance (2, 2) of x and y, m^2."""

    mean: Array
    covariance_m2: Array


class Stepped(NamedTuple):
    """The weighted cloud after a step, its moments, its effective sample size, and what happened.

    resampled: before it moved; diverged: all particles had lost, and weigh the same again.
    """

    cloud: Cloud
    moments: Moments
    effective: float
    resampled: bool
    diverged: bool


def cell_table(grid: FieldGrid, layer: int = 0) -> CellTable:
    """The table of one layer of a vector map of at least two by two cells."""
    mean = grid.mean_uT[layer]
    assert mean.shape[2] == 3, mean.shape
    assert min(mean.shape[:2]) > 1, mean.shape
    variance = np.mean(np.square(grid.sd_uT[layer]), axis=2)
    record = np.concatenate([mean, np.where(grid.measured[layer], variance, _UNMEASURED_UT2)[..., None]], axis=2)
    x0, y0 = grid.origin_m
    return CellTable(np.ascontiguousarray(record, np.float32), *map(np.float32, (x0, y0, 1.0 / grid.resolution_m)))


def moments_of(sums: Array) -> Moments:
    """Of sums (12,) of w, w times each row, w x x, w x y, w y y, w w, all about the first particle, and its x and y."""
    mean = sums[1:6] / sums[0]
    xx, xy, yy = sums[6:9] / sums[0] - mean[[0, 0, 1]] * mean[[0, 1, 1]]
    mean[:2] += sums[10:]
    return Moments(mean, np.array([[xx, xy], [xy, yy]]))
