"""From likelihoods over candidate places to a position: ML, MLR and ABL (Shockley 8.1-8.3), and their gate (8.5).

All three are scale-free: they accept a uniformly bad match, so a chi-square gate goes with them. With correlated errors
the likelihoods passed in are the tempered ones.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from app.geometry import Array

__all__ = [
    "Bin", "Rival", "StretchBin", "best_bin", "best_stretch_bin", "chi_square_limit",
    "likelihood_rival", "normalised_mass", "peak_over_uniform",
]  # fmt: skip


class Rival(NamedTuple):
    """The best candidate beyond the exclusion radius: its index and log(best / rival)."""

    candidate: int
    log_ratio: float


class Bin(NamedTuple):
    """The heaviest bin: its mass and the likelihood-weighted mean (row, column) of the cells in it."""

    mass: float
    row: float
    column: float


class StretchBin(NamedTuple):
    """The heaviest bin along a list of samples: its mass, its samples `first` to `stop` (excluded), and their mean.

    `position_m` (d,) is the likelihood-weighted mean of the samples' positions.
    """

    mass: float
    first: int
    stop: int
    position_m: Array


def normalised_mass(log_l: Array) -> Array:
    """Likelihoods (..., m) as shares of their sum, whatever their scale (Shockley 8.3)."""
    weight = np.exp(log_l - log_l.max(axis=-1, keepdims=True))
    return np.asarray(weight / weight.sum(axis=-1, keepdims=True))


def likelihood_rival(
    positions_m: Array, planes: NDArray[np.int64], log_l: Array, best: int, min_distance_m: float
) -> Rival | None:
    """The strongest candidate at least `min_distance_m` from `best`, or on another plane (Shockley 8.2, L1086)."""
    apart = np.linalg.norm(positions_m - positions_m[best], axis=1) >= min_distance_m
    outside = np.flatnonzero(apart | (planes != planes[best]))
    if not len(outside):
        return None
    rival = int(outside[np.argmax(log_l[outside])])
    return Rival(rival, float(log_l[best] - log_l[rival]))


def best_bin(mass: Array, cells: int) -> Bin:
    """The square of `cells` x `cells` with the most mass (ny, nx) in it, sliding by one cell (Shockley 8.3, L1096)."""
    rows, columns = min(cells, mass.shape[0]), min(cells, mass.shape[1])
    table = np.zeros((mass.shape[0] + 1, mass.shape[1] + 1))
    np.cumsum(np.cumsum(mass, axis=0), axis=1, out=table[1:, 1:])
    sums = table[rows:, columns:] - table[:-rows, columns:] - table[rows:, :-columns] + table[:-rows, :-columns]
    j, i = np.unravel_index(int(np.argmax(sums)), sums.shape)
    inside = mass[j : j + rows, i : i + columns]
    total = float(inside.sum())
    row = j + float(inside.sum(axis=1) @ np.arange(rows)) / total
    column = i + float(inside.sum(axis=0) @ np.arange(columns)) / total
    return Bin(total, row, column)


def best_stretch_bin(
    mass: Array, along_m: Array, stretch: NDArray[np.int64], position_m: Array, width_m: float
) -> StretchBin:
    """The window of `width_m` along a list of samples with the most mass (m,) in it (Shockley 8.3, L1096).

    Windows begin at each sample, hold its end no more, and never leave its stretch; `along_m` (m,) increases within a
    stretch, `stretch` (m,) increases; `position_m` (m, d). In metres, so that uneven spacing does not matter.
    """
    step = float(along_m.max() - along_m.min()) + 2.0 * width_m
    key = along_m - along_m.min() + stretch * step
    stop = np.searchsorted(key, key + width_m * (1.0 - 1e-9), side="left")
    sums = np.concatenate([[0.0], np.cumsum(mass)])
    first = int(np.argmax(sums[stop] - sums[:-1]))
    inside = slice(first, int(stop[first]))
    total = float(mass[inside].sum())
    return StretchBin(total, first, inside.stop, mass[inside] @ position_m[inside] / total)


def peak_over_uniform(mass: Array, cells: int) -> float:
    """The largest share of the mass as a multiple of 1 / cells: ABL's threshold made scale-free (Shockley 8.5)."""
    return float(mass.max() / mass.sum() * cells)


def chi_square_limit(scalars: float, probability: float) -> float:
    """The squared Mahalanobis distance that `scalars` independent measurements exceed with 1 - probability."""
    return float(2.0 * gammaincinv(scalars / 2.0, probability))
