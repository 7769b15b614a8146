"""Walks through a synthetic building: survey lanes and random waypoints, at walking pace with a phone in the hand."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d

from app.geometry import Array, wrap_angle_rad
from app.synthetic.building import DEVICE_HEIGHT_M, SyntheticBuilding
from app.synthetic.noise import ornstein_uhlenbeck

__all__ = ["SyntheticWalk", "lawn_mower", "random_waypoints"]

_FINE_M = 0.05  # spacing of the path before it is sampled in time
_STRIDE_M = 0.7
_BOB_M = 0.02
_PACE_SPREAD = 0.05
_CHOICES = 3
_TURN_S = 0.25  # the device turns with the person, not at once


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticWalk:
    """Where the device truly was: `t_s` (n,), `p_building_m` (n, 3), `heading_rad` (n,); held level, facing forward."""

    floor: int
    t_s: Array
    p_building_m: Array
    heading_rad: Array

    def __len__(self) -> int:
        return len(self.t_s)

    def path_length_m(self) -> Array:
        """(n,) distance walked since the start, along the floor."""
        steps = np.linalg.norm(np.diff(self.p_building_m[:, :2], axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])


def lawn_mower(
    building: SyntheticBuilding,
    floor: int,
    rng: np.random.Generator,
    *,
    along: Literal["x", "y"] = "x",
    lane_m: float = 1.0,
    offset_m: float = 0.0,
    speed_m_s: float = 1.2,
    rate_hz: float = 10.0,
) -> SyntheticWalk:
    """There and back over the whole walkable area, in lanes `lane_m` apart, the first `offset_m` from the edge."""
    x0, y0, x1, y1 = building.walkable_m
    lo, hi, first, last = (x0, x1, y0, y1) if along == "x" else (y0, y1, x0, x1)
    lanes = np.arange(first + offset_m, last + 1e-9, lane_m)
    there_and_back = np.where(np.arange(len(lanes))[:, None] % 2, [hi, lo], [lo, hi])
    corners = np.stack([there_and_back.ravel(), np.repeat(lanes, 2)], axis=1)
    return _walk(building, floor, rng, corners if along == "x" else corners[:, ::-1], 0.2, speed_m_s, rate_hz)


def random_waypoints(
    building: SyntheticBuilding,
    floor: int,
    rng: np.random.Generator,
    *,
    length_m: float,
    speed_m_s: float = 1.2,
    rate_hz: float = 10.0,
) -> SyntheticWalk:
    """A walk of at least `length_m` between random places, with rounded turns."""
    x0, y0, x1, y1 = building.walkable_m
    shortest_leg_m = min(4.0, 0.4 * max(x1 - x0, y1 - y0))
    corners = [rng.uniform([x0, y0], [x1, y1])]
    before = rng.normal(size=2)
    walked_m = 0.0
    while walked_m < 1.1 * length_m + 2.0:  # rounding the turns shortens the path
        legs = rng.uniform([x0, y0], [x1, y1], size=(_CHOICES, 2)) - corners[-1]
        legs_m = np.linalg.norm(legs, axis=1)
        ahead = np.where(legs_m >= shortest_leg_m, legs @ before / legs_m, -np.inf)
        chosen = int(np.argmax(ahead))  # of a few places, the one most nearly ahead: people rarely turn round
        if np.isfinite(ahead[chosen]):
            before = legs[chosen]
            corners.append(corners[-1] + before)
            walked_m += float(legs_m[chosen])
    return _walk(building, floor, rng, np.array(corners), 0.7, speed_m_s, rate_hz)


def _walk(
    building: SyntheticBuilding,
    floor: int,
    rng: np.random.Generator,
    corners_m: Array,
    rounding_m: float,
    speed_m_s: float,
    rate_hz: float,
) -> SyntheticWalk:
    """Round the corners, walk the path at a slightly uneven pace, and bob with the steps."""
    xy, s = _rounded(corners_m, rounding_m)
    t = np.arange(0.0, s[-1] / (speed_m_s * (1.0 - 4.0 * _PACE_SPREAD)), 1.0 / rate_hz)
    pace = speed_m_s * (1.0 + np.clip(ornstein_uhlenbeck(rng, t, _PACE_SPREAD, 8.0)[:, 0], -0.2, 0.2))
    walked = np.concatenate([[0.0], np.cumsum(pace[:-1] / rate_hz)])
    t, walked = t[walked <= s[-1]], walked[walked <= s[-1]]
    p = np.stack([np.interp(walked, s, xy[:, 0]), np.interp(walked, s, xy[:, 1])], axis=1)
    tangent = np.gradient(xy, axis=0)
    heading = np.interp(walked, s, np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0])))
    heading = gaussian_filter1d(heading, _TURN_S * rate_hz, mode="nearest")
    bob = _BOB_M * np.sin(2 * np.pi * walked / _STRIDE_M + rng.uniform(0.0, 2 * np.pi))
    z = building.elevations_m[floor] + DEVICE_HEIGHT_M + bob + ornstein_uhlenbeck(rng, t, 0.01, 5.0)[:, 0]
    return SyntheticWalk(floor, t, np.column_stack([p, z]), wrap_angle_rad(heading))


def _rounded(corners_m: Array, rounding_m: float) -> tuple[Array, Array]:
    """A polyline at fine spacing with its corners rounded (Gaussian of sd `rounding_m`), and the length along it."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners_m, axis=0), axis=1))])
    s = np.arange(0.0, length[-1], _FINE_M)
    xy = np.stack([np.interp(s, length, corners_m[:, axis]) for axis in (0, 1)], axis=1)
    xy = gaussian_filter1d(xy, rounding_m / _FINE_M, axis=0, mode="nearest")
    return xy, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
