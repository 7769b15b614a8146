"""Keeping to a path: the error across it, the controller that steers, and the frame of scores (Storms 1.15-1.19)."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.geometry import Array

__all__ = [
    "STORMS_GAINS", "CrossTrack", "PidGains", "PidMemory", "cross_track", "pid_step", "place_on_true_path", "polyline",
    "signed_offset",
]  # fmt: skip


class CrossTrack(NamedTuple):
    """The place of a path closest to a point: closest_m (2,), unit tangent (2,) there, segment, arc length along_m.

    error_m is positive where the path lies to the left of the point, seen along the path: steering left reduces it.
    """

    closest_m: Array
    tangent: Array
    error_m: float
    segment: int
    along_m: float

    @property
    def left(self) -> Array:
        """(2,) unit vector to the left of the path."""
        return np.array([-self.tangent[1], self.tangent[0]])


@dataclass(frozen=True, slots=True)
class PidGains:
    """1/s^2, 1/s^3 and 1/s from metres to m/s^2; `limit_m_s2` bounds the command and stops the integral (None: not).

    `derivative_on` "measurement" takes the velocity across the path, which jumps neither with the reference nor with a
    corrected position; "error" is the textbook's difference of errors.
    """

    proportional: float
    integral: float
    derivative: float
    limit_m_s2: float | None = None
    derivative_on: str = "measurement"

    def __post_init__(self) -> None:
        assert self.derivative_on in ("measurement", "error"), self.derivative_on


STORMS_GAINS = PidGains(10.0, 0.05, 3.5)
"""(Storms, L616)."""


class PidMemory(NamedTuple):
    """Integral of the error, m s, and the last error, m; None before the first."""

    integral_m_s: float = 0.0
    last_error_m: float | None = None


def polyline(path_m: Array) -> Array:
    """A path (n, 2) without points that repeat the one before.

    Raises AssertionError when fewer than two are left.
    """
    moved = np.concatenate([[True], np.any(np.diff(path_m, axis=0) != 0.0, axis=1)])
    assert moved.sum() >= 2, "a path needs two different points"
    return np.asarray(path_m[moved])


def cross_track(path_m: Array, point_m: Array) -> CrossTrack:
    """From a point (2,) to the nearest segment of a polyline (n, 2), clamped to its ends (Storms, L602-607).

    Segments rather than nearest points, so that nothing jumps at a corner.
    """
    start, (dx, dy) = path_m[:-1], np.diff(path_m, axis=0).T
    squared = dx * dx + dy * dy
    x, y = start[:, 0] - point_m[0], start[:, 1] - point_m[1]
    share = np.minimum(np.maximum(-(x * dx + y * dy) / squared, 0.0), 1.0)
    x, y = x + share * dx, y + share * dy
    k = int(np.argmin(x * x + y * y))
    length = np.sqrt(squared)
    tangent, off = np.array([dx[k], dy[k]]) / length[k], np.array([x[k], y[k]])
    side = 1.0 if tangent[0] * off[1] - tangent[1] * off[0] >= 0.0 else -1.0
    along = float(length[:k].sum() + share[k] * length[k])
    return CrossTrack(point_m + off, tangent, side * float(np.hypot(*off)), k, along)


def pid_step(
    gains: PidGains, memory: PidMemory, error_m: float, rate_m_s: float, dt_s: float
) -> tuple[float, PidMemory]:
    """The command, m/s^2, towards the path for an error, and the velocity `rate_m_s` in the same direction.

    A positive gain on a positive error drives towards the path (Storms, L607).
    """
    integral = memory.integral_m_s + error_m * dt_s
    slope = -rate_m_s
    if gains.derivative_on == "error":
        slope = 0.0 if memory.last_error_m is None else (error_m - memory.last_error_m) / dt_s
    command = gains.proportional * error_m + gains.integral * integral + gains.derivative * slope
    if gains.limit_m_s2 is not None and abs(command) > gains.limit_m_s2:
        return float(np.clip(command, -gains.limit_m_s2, gains.limit_m_s2)), PidMemory(memory.integral_m_s, error_m)
    return command, PidMemory(integral, error_m)


def place_on_true_path(point_m: Array, closest_m: Array, true_a_m: Array, true_b_m: Array) -> Array | None:
    """Where a follower would be had its leader known its own path exactly: Appendix A as a line intersection.

    The line from `point_m` through `closest_m`, its place on the leader's estimated path, meets that through the true
    points a and b (all (2,)); what separates path and meeting is added to the point (Storms, L897-916, whose law of
    sines errs where the meeting lies behind a). None where the point is on the path or the lines are parallel.
    """
    towards, along = closest_m - point_m, true_b_m - true_a_m
    length = float(np.hypot(*towards))
    area = towards[0] * along[1] - towards[1] * along[0]
    if length == 0.0 or abs(area) < 1e-9 * length * float(np.hypot(*along)):
        return None
    off = true_a_m - closest_m
    return np.asarray(point_m + (off[0] * along[1] - off[1] * along[0]) / area * towards)


def signed_offset(path_m: Array, point_m: Array) -> float:
    """How far a point (2,) is to the left of a path (n, 2), m: minus the cross-track error."""
    return -cross_track(path_m, point_m).error_m
