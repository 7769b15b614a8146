"""A leader's walk becomes a map at once, and a follower keeps to it (Storms 1.14-1.18).

The leader carries sensors side by side and places them by its own estimate; whatever that errs, the map and the path
err alike, and the follower inherits it (Storms, L802). Outside the leader's swath nothing is known.
"""

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from app.geometry import Array
from app.tracking.cross_track import STORMS_GAINS, PidGains, PidMemory, cross_track, pid_step
from app.tracking.kalman import GaussianBelief
from app.tracking.map_cells import MapCells
from app.tracking.ml_kalman import MlKalman

__all__ = [
    "COMPLETE_M", "SENSOR_SPACING_M", "SUCCESSFUL_M", "Follower", "LeaderLog", "Outcome", "Steering",
    "lateral_offsets_m", "leader_map", "outcome_of", "sensor_places_m", "turn_command_m_s2",
]  # fmt: skip

SENSOR_SPACING_M = 0.381
COMPLETE_M, SUCCESSFUL_M = 16.0, 10.0
"""How far along the side hallway a follower must come (Storms, L777, L821)."""

Outcome = Literal["complete", "successful", "past turn", "no turn"]


@dataclass(frozen=True, slots=True, eq=False)
class LeaderLog:
    """What a leader shares (Storms, L449, L587): times (n,), its *estimated* positions (n, 2) and headings (n,), and
    readings (n, s, c) uT, in the building frame, of sensors at lateral offsets (s,), m, positive to the left.
    """

    t_s: Array
    position_m: Array
    heading_rad: Array
    reading_uT: Array
    offset_m: Array

    def corrected(self, position_m: Array) -> "LeaderLog":
        """The same readings at positions (n, 2) found out later, by smoothing say."""
        return replace(self, position_m=position_m)


class Steering(NamedTuple):
    """A command (2,), m/s^2; what the controller remembers; the cross-track error by the follower's own estimate."""

    control_m_s2: Array
    memory: PidMemory
    error_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Follower:
    """A tracker on the leader's map, and the leader's path (n, 2) that the controller keeps to."""

    tracker: MlKalman
    path_m: Array
    gains: PidGains = STORMS_GAINS

    def steer(self, belief: GaussianBelief, memory: PidMemory, heading_rad: float, dt_s: float) -> Steering:
        """Sideways only, as seen along the heading: nothing controls how far along the follower is (Storms, L598).

        Not along the path's own normal: where the leader's estimate jumped its path has kinks, and a controller that
        follows their normals brakes the vehicle to a stop.
        """
        left = np.array([-np.sin(heading_rad), np.cos(heading_rad)])
        across_m = (cross_track(self.path_m, belief.position_m).closest_m - belief.position_m) @ left
        command, memory = pid_step(self.gains, memory, float(across_m), float(belief.mean[2:] @ left), dt_s)
        return Steering(command * left, memory, float(across_m))


def lateral_offsets_m(sensors: int, spacing_m: float = SENSOR_SPACING_M) -> Array:
    """(s,) offsets of a row of sensors about the vehicle's middle; the source does not place its fourth."""
    return np.asarray(spacing_m * (np.arange(sensors) - (sensors - 1) / 2.0))


def sensor_places_m(position_m: Array, heading_rad: Array, offset_m: Array) -> Array:
    """(n, s, 2) where sensors at lateral offsets (s,) are, from positions (n, 2) and headings (n,)."""
    left = np.stack([-np.sin(heading_rad), np.cos(heading_rad)], axis=-1)
    return np.asarray(position_m[:, None] + offset_m[:, None] * left[:, None])


def leader_map(
    log: LeaderLog, resolution_m: float, variance_uT2: float = 0.0, longest_edge_m: float = np.inf
) -> MapCells:
    """Readings at estimated places, linear between them; unknown outside their convex hull (Storms, L589).

    The hull of an L holds ground nobody saw: triangles with a longer edge than `longest_edge_m` are left out.
    `variance_uT2` per component is what the map is said to err by.
    """
    place_m = sensor_places_m(log.position_m, log.heading_rad, log.offset_m).reshape(-1, 2)
    reading = log.reading_uT.reshape(len(place_m), -1)
    triangles = Delaunay(place_m)
    low, high = place_m.min(axis=0), place_m.max(axis=0)
    x, y = (np.arange(round(np.ceil((b - a) / resolution_m)) + 1) * resolution_m + a
            for a, b in zip(low, high, strict=True))  # fmt: skip
    cells = np.stack(np.meshgrid(x, y), axis=-1)
    mean = LinearNDInterpolator(triangles, reading)(cells)
    corner = place_m[triangles.simplices]
    edge_m = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
    inside = triangles.find_simplex(cells)
    known = (inside >= 0) & (edge_m[inside] <= longest_edge_m) & np.isfinite(mean).all(axis=-1)
    mean = np.where(known[..., None], mean, np.nan)
    return MapCells((float(low[0]), float(low[1])), resolution_m, mean, np.full_like(mean, variance_uT2), known)


def turn_command_m_s2(belief: GaussianBelief, turn_rad: float, dt_s: float) -> Array:
    """(2,) the acceleration that turns the estimated velocity within a step: u_1 of eq. 3.7 (Storms, L598)."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    velocity = belief.mean[2:]
    return np.asarray((np.array([[c, -s], [s, c]]) @ velocity - velocity) / dt_s)


def outcome_of(past_corner_m: float | None) -> Outcome:
    """The class of a run by how far it came along the side hallway; None: it never made the corner."""
    if past_corner_m is None:
        return "no turn"
    if past_corner_m >= COMPLETE_M:
        return "complete"
    return "successful" if past_corner_m >= SUCCESSFUL_M else "past turn"
