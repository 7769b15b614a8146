"""Kuevor's five flight profiles in the room (Kuevor, B4; L1159-L1184), flown by a drone that leans into its turns.

z is up and the room's centre the origin. The thrust is along the body's z axis, so the drone's tilt follows from its
acceleration, and its accelerometer, which feels thrust alone, reads along z whatever the tilt: that is why a filter
that takes each reading for gravity is ten degrees wrong on the fast circle (Kuevor, B23).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from app.geometry import Array
from app.synthetic.imu import GRAVITY_M_PER_S2, path_acceleration_m_per_s2

__all__ = ["PROFILES", "Flight", "fly_profile"]

Profile = Literal["A", "B", "C", "D", "E"]
PROFILES: tuple[Profile, ...] = ("A", "B", "C", "D", "E")
_ALTITUDE_M = 1.5
_HOVER_S = 5.0
_CIRCLES = {"B": (1.4, 1.0, 0.0), "C": (1.0, 1.5, 0.0), "D": (1.4, 1.0, np.deg2rad(30.0))}  # radius, speed, inclination
_SWING_M, _SWING_RAD_PER_S = 0.3, 3.0  # the seed says 3 Hz; at that rate no drone swings 0.3 m: 107 m/s^2


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """t_s (n,), p_building_m, acceleration_m_per_s2 (n, 3), q_body_to_building (n, 4)."""

    t_s: Array
    p_building_m: Array
    acceleration_m_per_s2: Array
    q_body_to_building: Array


def fly_profile(profile: Profile, *, seconds: float = 120.0, rate_hz: float = 200.0) -> Flight:
    """A rectangle with hovers, B slow, C fast, D inclined circle, E swings along x, then y; from rest and a hover.

    Circles are 0.1 m smaller than the seed's 1.5 m, to stay in the box that is mapped.
    """
    t = np.arange(int(seconds * rate_hz)) / rate_hz
    if profile == "A":
        p, heading = _rectangle(t), np.zeros(len(t))
    elif profile == "E":
        p, heading = _swings(t, seconds), np.zeros(len(t))
    else:
        p, heading = _circle(t, *_CIRCLES[profile])
    acceleration = path_acceleration_m_per_s2(t, p)
    return Flight(t, p, acceleration, _leaning(acceleration, heading))


def _leaning(acceleration_m_per_s2: Array, heading_rad: Array) -> Array:
    """(n, 4) attitude whose z axis is along the thrust and whose x axis has the heading."""
    thrust = acceleration_m_per_s2 + np.array([0.0, 0.0, GRAVITY_M_PER_S2])
    z = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    forward = np.stack([np.cos(heading_rad), np.sin(heading_rad), np.zeros_like(heading_rad)], axis=1)
    y = np.cross(z, forward)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    return np.asarray(Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2)).as_quat(scalar_first=True))


def _ease(u: Array) -> Array:
    """From 0 to 1, at rest at both ends."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2))


def _rectangle(t: Array) -> Array:
    """Ten seconds at every corner, ten for every leg, round and round."""
    corners = np.array([[1.75, 1.25], [-1.75, 1.25], [-1.75, -1.25], [1.75, -1.25]])
    leg = (t // 20.0).astype(int)
    part = _ease((t % 20.0 - 10.0) / 10.0)[:, None]
    xy = (1.0 - part) * corners[leg % 4] + part * corners[(leg + 1) % 4]
    return np.column_stack([xy, np.full(len(t), _ALTITUDE_M)])


def _circle(t: Array, radius_m: float, speed_m_per_s: float, inclination_rad: float) -> tuple[Array, Array]:
    """Speeds up within three seconds of the hover; heading along the path."""
    rate = speed_m_per_s / radius_m * _ease((t - _HOVER_S) / 3.0)
    angle = np.cumsum(rate) * (t[1] - t[0])
    x, y, z = radius_m * np.cos(angle), radius_m * np.sin(angle), np.zeros(len(t))
    p = np.stack([x * np.cos(inclination_rad), y, z + x * np.sin(inclination_rad) + _ALTITUDE_M], axis=1)
    return p, np.unwrap(np.arctan2(np.cos(angle), -np.sin(angle) * np.cos(inclination_rad)))


def _swings(t: Array, seconds: float) -> Array:
    half = 0.5 * seconds
    p = np.tile([0.5, 0.3, _ALTITUDE_M], (len(t), 1))
    for axis, start in ((0, _HOVER_S), (1, half + _HOVER_S)):
        gain = _ease((t - start) / 3.0) * _ease((start + half - 2.0 * _HOVER_S - t) / 3.0)
        p[:, axis] += _SWING_M * gain * np.sin(_SWING_RAD_PER_S * (t - start))
    return p
