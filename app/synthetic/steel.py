"""The steel of the synthetic building: dipoles, thin bars and cuboids, whose field is known everywhere.

Outside the steel every one of these fields is free of curl and divergence, as a real static field in air is.

dipole  B = 3 (m . r) r / |r|^5 - m / |r|^3, with m = mu_0 / (4 pi) times the moment: 0.1 uT m^3 per A m^2
bar     thin and magnetised along its length: a pole +q at one end and -q at the other, B = q r / |r|^3 of each, q in
        uT m^2 (mu_0 / (4 pi) times magnetisation times cross section)
cuboid  uniformly magnetised, polarisation J in uT, axes along the building's; evaluated by magpylib
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.geometry import Array

__all__ = ["Bars", "Cuboids", "Dipoles"]

_ROWS = 2048  # points at a time: keeps (points x sources) temporaries in the cache


@dataclass(frozen=True, slots=True, eq=False)
class Dipoles:
    """Point dipoles: `position_m` (k, 3), `moment_uT_m3` (k, 3)."""

    position_m: Array
    moment_uT_m3: Array

    def field_uT(self, points_m: Array) -> Array:
        """The field at points (n, 3), uT."""
        return _by_rows(points_m, self._rows)

    def scaled(self, factor: Array | float) -> "Dipoles":
        """Each source made `factor` (k,) times as strong, or all by one factor."""
        return Dipoles(self.position_m, self.moment_uT_m3 * np.reshape(factor, (-1, 1)))

    def _rows(self, p: Array) -> Array:
        inverse_r2 = 1.0 / _squared_distance(p, self.position_m)
        w = inverse_r2 * np.sqrt(inverse_r2)
        m_dot_r = p @ self.moment_uT_m3.T - np.sum(self.position_m * self.moment_uT_m3, axis=1)
        u = 3.0 * m_dot_r * w * inverse_r2
        return np.asarray(p * u.sum(axis=1, keepdims=True) - u @ self.position_m - w @ self.moment_uT_m3)


@dataclass(frozen=True, slots=True, eq=False)
class Bars:
    """Thin bars magnetised from `start_m` (k, 3) towards `end_m` (k, 3): poles -`strength_uT_m2` (k,) and +."""

    start_m: Array
    end_m: Array
    strength_uT_m2: Array

    @property
    def position_m(self) -> Array:
        """(2 k, 3) the poles: ends, then starts."""
        return np.concatenate([self.end_m, self.start_m])

    def field_uT(self, points_m: Array) -> Array:
        """The field at points (n, 3), uT."""
        return _by_rows(points_m, self._rows)

    def scaled(self, factor: Array | float) -> "Bars":
        """Each bar made as many times as strong as the weaker of its poles' factors (2 k,), or all by one factor."""
        per_bar = np.min(np.reshape(factor, (2, -1)), axis=0) if np.ndim(factor) else factor
        return Bars(self.start_m, self.end_m, self.strength_uT_m2 * per_bar)

    def _rows(self, p: Array) -> Array:
        poles = self.position_m
        inverse_r2 = 1.0 / _squared_distance(p, poles)
        w = np.concatenate([self.strength_uT_m2, -self.strength_uT_m2]) * inverse_r2 * np.sqrt(inverse_r2)
        return np.asarray(p * w.sum(axis=1, keepdims=True) - w @ poles)


@dataclass(frozen=True, slots=True, eq=False)
class Cuboids:
    """Uniformly magnetised cuboids: centres `position_m`, `size_m` and `polarisation_uT`, each (k, 3)."""

    position_m: Array
    size_m: Array
    polarisation_uT: Array

    def field_uT(self, points_m: Array) -> Array:
        """The field at points (n, 3), uT."""
        from magpylib.core import magnet_cuboid_Bfield  # imported here: it takes a third of a second

        total = np.zeros_like(points_m)
        for centre, size, polarisation in zip(self.position_m, self.size_m, self.polarisation_uT, strict=True):
            each = np.broadcast_to(np.stack([size, polarisation])[:, None, :], (2, *points_m.shape))
            total += magnet_cuboid_Bfield(observers=points_m - centre, dimensions=each[0], polarizations=each[1])
        return total

    def scaled(self, factor: Array | float) -> "Cuboids":
        """Each source made `factor` (k,) times as strong, or all by one factor."""
        return Cuboids(self.position_m, self.size_m, self.polarisation_uT * np.reshape(factor, (-1, 1)))


def _squared_distance(p: Array, sources_m: Array) -> Array:
    """(n, k) squared distances, m^2."""
    return np.asarray(np.sum(p * p, axis=1)[:, None] + np.sum(sources_m * sources_m, axis=1) - 2.0 * (p @ sources_m.T))


def _by_rows(points_m: Array, rows: Callable[[Array], Array]) -> Array:
    out = np.empty_like(points_m)
    for first in range(0, len(points_m), _ROWS):
        out[first : first + _ROWS] = rows(points_m[first : first + _ROWS])
    return out
