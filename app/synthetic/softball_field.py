"""Cuenca's field of grass as he modelled it, tracks "S" and "O" over it, the sensors of his drone (Cuenca 1.4, 1.13).

His polynomial is a self-consistent synthetic field, not the surveyed one: its coefficients are rounded to more than it
varies. x is the side of 9 m, y of 37 m; z points up. Waypoints are ours, as are the sensors' noises by default: the
source prints neither in a usable form.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from app.geometry import UT_PER_GAUSS, Array
from app.tracking.inertial_ekf import GRAVITY_M_S2, body_to_building
from app.tracking.map_cells import MapCells

__all__ = [
    "EXTENT_M", "LITERAL_NOISE", "Flight", "SensorNoise", "SensorLog", "fly_track", "indoor_cells", "polynomial_cells",
    "polynomial_norm_uT", "sense",
]  # fmt: skip

EXTENT_M = (9.0, 37.0)
CELL_M = 0.1

_COEFFICIENT_G = {
    (0, 0): 0.462,
    (1, 0): 2.47e-3, (0, 1): -3.6e-4,
    (2, 0): -1.84e-3, (1, 1): 1.8e-4, (0, 2): 4.575e-5,
    (3, 0): 3.9e-4, (2, 1): 1.514e-5, (1, 2): -1.96e-5, (0, 3): -1.97e-6,
    (4, 0): -3.61e-5, (3, 1): -3.479e-6, (2, 2): -4.297e-8, (1, 3): 7.53e-7, (0, 4): 3.46e-8,
    (5, 0): 1.125e-6, (4, 1): 2.56e-7, (3, 2): -1.13e-8, (2, 3): 3.16e-9, (1, 4): -1.01e-8, (0, 5): -2.05e-10,
}  # fmt: skip
"""Of x^i y^j, in gauss (Cuenca, L944-950, eq. 4.1)."""

_WAYPOINTS_M = {
    "S": ([1.5, 7.5, 7.5, 1.5, 1.5, 7.5, 7.5, 1.5], [3.0, 4.0, 9.0, 12.0, 19.0, 22.0, 28.0, 32.0]),
    "O": ([4.5, 7.3, 7.5, 7.3, 4.5, 1.7, 1.5, 1.7, 4.5], [4.0, 8.0, 18.0, 28.0, 32.0, 28.0, 18.0, 8.0, 4.0]),
}


class Flight(NamedTuple):
    """Truth every `dt_s`: position, velocity, acceleration (n, 3) in the building frame; roll, pitch, yaw (n, 3)."""

    position_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    angles_rad: Array
    dt_s: float


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Per sample: accelerometer, gyro, magnetometer (of the magnitude), and the GPS."""

    force_sd_m_s2: float = 0.032
    rate_sd_rad_s: float = 0.0032
    norm_sd_uT: float = 0.0707
    gps_sd_m: float = 0.1
    gps_velocity_sd_m_s: float = 0.05


LITERAL_NOISE = SensorNoise(force_sd_m_s2=0.316, rate_sd_rad_s=0.1)
"""The source's IMU "noise powers" taken as spectral densities at 100 Hz (Cuenca, L779)."""


class SensorLog(NamedTuple):
    """Readings at every step: specific force and turn rate (n, 3) of the body; magnitude (n,); GPS's answers (n, 3)."""

    force_m_s2: Array
    rate_rad_s: Array
    norm_uT: Array
    gps_m: Array
    gps_velocity_m_s: Array


def polynomial_norm_uT(points_m: Array) -> Array:
    """(n,) magnitude at points (n, 2) or (n, 3), uT (Cuenca, L944-950, eq. 4.1)."""
    x, y = points_m[..., 0], points_m[..., 1]
    gauss = sum(c * x**i * y**j for (i, j), c in _COEFFICIENT_G.items())
    return np.asarray(UT_PER_GAUSS * gauss)


def polynomial_cells() -> MapCells:
    """The map of it on 0.1 m, 91 x 371 cells (Cuenca, L587)."""
    return _cells(polynomial_norm_uT(_places_m()))


def indoor_cells(rng: np.random.Generator, gradient_uT_per_m: float = 5.0, waves: int = 40) -> MapCells:
    """A map of the same ground with the slopes of a building: plane waves 2.5 to 8 m long, so steep at the median."""
    places = _places_m()
    number = 2.0 * np.pi / rng.uniform(2.5, 8.0, waves)
    direction = rng.uniform(0.0, 2.0 * np.pi, waves)
    k = number * np.array([np.cos(direction), np.sin(direction)])
    values = (np.cos(places @ k + rng.uniform(0.0, 2.0 * np.pi, waves)) / number).sum(axis=-1)
    slope = np.hypot(*np.gradient(values, CELL_M))
    return _cells(48.0 + gradient_uT_per_m / float(np.median(slope)) * values)


def fly_track(shape: Literal["S", "O"], duration_s: float = 40.0, dt_s: float = 0.01) -> Flight:
    """A level flight through waypoints by cubic splines over time, nose along the path (Cuenca, L750-761)."""
    x, y = _WAYPOINTS_M[shape]
    knots = np.linspace(0.0, duration_s, len(x))
    spline = CubicSpline(knots, np.column_stack([x, y, np.full(len(x), 2.0)]))
    t = np.arange(0.0, duration_s + 0.5 * dt_s, dt_s)
    velocity = spline(t, 1)
    yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    return Flight(spline(t), velocity, spline(t, 2), np.column_stack([np.zeros((len(t), 2)), yaw]), dt_s)


def sense(flight: Flight, cells: MapCells, rng: np.random.Generator, noise: SensorNoise | None = None) -> SensorLog:
    """What the sensors read: white noise on all (Cuenca, L767-779); the IMU without its second-order dynamics."""
    noise = noise or SensorNoise()
    n = len(flight.position_m)
    upwards = flight.acceleration_m_s2 + np.array([0.0, 0.0, GRAVITY_M_S2])
    force = np.array([body_to_building(*a).T @ f for a, f in zip(flight.angles_rad, upwards, strict=True)])
    rate = np.zeros((n, 3))
    rate[:, 2] = np.gradient(flight.angles_rad[:, 2], flight.dt_s)
    return SensorLog(
        force + noise.force_sd_m_s2 * rng.normal(size=(n, 3)),
        rate + noise.rate_sd_rad_s * rng.normal(size=(n, 3)),
        cells.at(flight.position_m[:, :2])[:, 0] + noise.norm_sd_uT * rng.normal(size=n),
        flight.position_m + noise.gps_sd_m * rng.normal(size=(n, 3)),
        flight.velocity_m_s + noise.gps_velocity_sd_m_s * rng.normal(size=(n, 3)),
    )


def _places_m() -> Array:
    """(371, 91, 2) the cells' centres."""
    axes = [np.arange(round(extent / CELL_M) + 1) * CELL_M for extent in EXTENT_M]
    return np.stack(np.meshgrid(*axes), axis=-1)


def _cells(norm_uT: Array) -> MapCells:
    known = np.ones(norm_uT.shape, dtype=np.bool_)
    return MapCells((0.0, 0.0), CELL_M, norm_uT[..., None], np.zeros((*norm_uT.shape, 1)), known)
