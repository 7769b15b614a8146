"""Walks that change floors on their way, by stairs or by a lift, with the height that a device reckons."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.synthetic.building import SyntheticBuilding
from app.synthetic.sensors import Magnetometer
from app.synthetic.steps import Carried, DeadReckoned, carry
from app.synthetic.walks import SyntheticWalk, random_waypoints

__all__ = ["StoreyWalk", "Way", "carry_between_storeys", "walk_between_storeys"]

Way = Literal["stairs", "lift"]

STAIRS_M = 6.0  # walked along the plan while one storey is climbed
LIFT_S = 8.0


@dataclass(frozen=True, slots=True, eq=False)
class StoreyWalk:
    """A walk with its height along the way: floor (n,) is the nearer one, risen_m (n,) since the start."""

    walk: SyntheticWalk
    floor: NDArray[np.int64]
    risen_m: Array


def walk_between_storeys(
    building: SyntheticBuilding, floor: int, to: int, way: Way, rng: np.random.Generator, *, length_m: float
) -> StoreyWalk:
    """A walk of at least `length_m` between random places that goes to another floor half way.

    Stairs are climbed along the path; in a lift one stands.
    """
    walk = random_waypoints(building, floor, rng, length_m=length_m)
    half_m = 0.5 * length_m
    climb_m = building.elevations_m[to] - building.elevations_m[floor]
    if way == "lift":
        walk, share = _waiting(walk, half_m)
    else:
        stairs_m = STAIRS_M * abs(climb_m) / building.storey_m
        share = np.clip((walk.path_length_m() - half_m) / stairs_m, 0.0, 1.0)
    risen_m = climb_m * share
    p_m = walk.p_building_m + np.column_stack([np.zeros((len(walk), 2)), risen_m])
    on = np.where(share > 0.5, to, floor)
    return StoreyWalk(replace(walk, p_building_m=p_m), on.astype(np.int64), risen_m)


def _waiting(walk: SyntheticWalk, at_m: float) -> tuple[SyntheticWalk, Array]:
    """The walk with a pause in a lift after `at_m`, and the share of the ride that is over (n,)."""
    at = int(np.searchsorted(walk.path_length_m(), at_m))
    pause_s = np.arange(0.0, LIFT_S, float(walk.t_s[1] - walk.t_s[0]))[1:]
    t_s = np.concatenate([walk.t_s[: at + 1], walk.t_s[at] + pause_s, walk.t_s[at + 1 :] + LIFT_S])
    stays = np.concatenate([np.arange(at + 1), np.full(len(pause_s), at), np.arange(at + 1, len(walk))])
    share = np.concatenate([np.zeros(at + 1), pause_s / LIFT_S, np.ones(len(walk) - at - 1)])
    return SyntheticWalk(walk.floor, t_s, walk.p_building_m[stays], walk.heading_rad[stays]), share


def carry_between_storeys(
    building: SyntheticBuilding,
    way: StoreyWalk,
    sensor: Magnetometer,
    reckoned: DeadReckoned,
    rng: np.random.Generator,
    *,
    height_scale_sd: float = 0.03,
) -> Carried:
    """As `carry`, with the height the device reckons: the climb, wrong by a few per cent of itself."""
    carried = carry(building, way.walk, sensor, reckoned, rng)
    told_m = way.risen_m * (1.0 + height_scale_sd * rng.normal())
    steps = tuple(
        replace(step, displacement_m=step.displacement_m + np.array([0.0, 0.0, risen]))
        for step, risen in zip(carried.steps, told_m, strict=True)
    )
    return Carried(steps, carried.truth_m, way.floor.astype(np.float64))
