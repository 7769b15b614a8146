"""What the compared filters of the sources share: maps as they read them, steps as moves, states of their own."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from app.field.grid import FieldGrid
from app.geometry import Array, wrap_angle_rad
from app.tracking.field_lookup import FieldTable, field_table
from app.tracking.map_cells import MapCells
from app.tracking.options import TrackOptions
from app.tracking.step import Step

__all__ = ["OFF_FLOOR_M", "Floor", "Moved", "moves", "nearest_floor", "own_state", "radius_95_m"]

OFF_FLOOR_M = 1.0
"""Above or below a floor's map: on stairs or in a lift, where it tells nothing."""
LEAST_APART_M = 0.5
STATE_95 = 2.448  # of a standard deviation: the radius that holds 95 % of a round Gaussian in two dimensions


def radius_95_m(covariance_m2: Array) -> float:
    """Of a covariance (2, 2), along its longest axis; infinite where nothing is said."""
    if not np.isfinite(covariance_m2).all():
        return np.inf
    return STATE_95 * float(np.sqrt(max(np.linalg.eigvalsh(covariance_m2)[1], 0.0)))


def own_state(radius_m: float, options: TrackOptions) -> str:
    """What a filter without states says of itself."""
    return "converged" if radius_m <= options.converged_radius_m else "searching"


@dataclass(frozen=True, slots=True, eq=False)
class Floor:
    """A map as these filters read it; variance_uT2 (c,) of one measurement about the field, the map's own aside."""

    floor_id: str
    grid: FieldGrid
    cells: MapCells
    norm: MapCells
    table: FieldTable
    height_m: float

    @classmethod
    def of(cls, floor_id: str, grid: FieldGrid) -> "Floor":
        layer = len(grid.heights_m) // 2
        cells = MapCells.of_grid(grid, layer)
        return cls(floor_id, grid, cells, cells.norm(), field_table(grid), float(grid.heights_m[layer]))

    @property
    def apart_m(self) -> float:
        """Between readings."""
        return max(self.grid.resolution_m, LEAST_APART_M)

    def variance_uT2(self, options: TrackOptions) -> Array:
        """(c,) of what the map learned of errors, and of the device's own."""
        return np.asarray(np.square(self.grid.noise_sd_uT) + options.bias_sd_uT**2 + options.noise_uT**2)


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """A step as a move: (3,) in the track's frame, how it turned, and whether its reading is compared with the map."""

    step: Step
    moved_m: Array
    elapsed_s: float
    turned_rad: float
    compared: bool


def moves(steps: tuple[Step, ...], apart_m: float) -> Iterator[Moved]:
    before, walked_m = steps[0], np.inf
    for step in steps:
        assert step.displacement_m is not None
        assert before.displacement_m is not None
        moved = step.displacement_m - before.displacement_m
        walked_m += float(np.linalg.norm(moved))
        compared = step.B_uT is not None and walked_m >= apart_m
        walked_m = 0.0 if compared else walked_m
        yaw = (step.yaw_rad or 0.0) - (before.yaw_rad or 0.0)
        yield Moved(step, moved, step.t_s - before.t_s, float(wrap_angle_rad(yaw)), compared)
        before = step


def nearest_floor(floors: tuple[Floor, ...], height_m: float, floor: int) -> int:
    """The floor of a height; the one it was on where heights do not tell floors apart."""
    heights = np.array([each.height_m for each in floors])
    return floor if len(set(heights)) < len(heights) else int(np.argmin(np.abs(heights - height_m)))
