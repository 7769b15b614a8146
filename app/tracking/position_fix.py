"""A position from one reading of the field, as a measurement for a Kalman filter (Storms 1.7-1.9).

`ml_fix` is the source's: the likeliest cell of prior times likelihood, with a variance from the widths of the
likelihood alone, to be fused with the same prior. `matched_fix` has the posterior's moments instead, which hold the
prior already and are not to be fused with it again (`kalman.condition_on_position`).
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri, ndtr

from app.geometry import Array
from app.tracking.grid_posterior import GridPosterior, grid_posterior, local_maxima, search_half_m
from app.tracking.map_cells import MapCells

__all__ = [
    "FixDiagnostics", "FixSettings", "PositionFix", "Refusal", "half_width_16_84", "lever_arm_agrees", "matched_fix",
    "ml_fix",
]  # fmt: skip

Refusal = Literal["innovation", "fit", "ambiguous", "border"]

_TAIL = float(ndtr(-1.0))
_AS_LIKELY = np.log(10.0)


@dataclass(frozen=True, slots=True)
class FixSettings:
    """noise_sd_uT: of the sensor, per component. map_variance: add the map's own (False: as the source)
    reach_sigmas, least_reach_m, most_reach_m: half side of the window searched; the source leaves it open
    slice_half_m: of the slices for the variance, whose ceiling it sets: 0.34 of a flat slice's length
    least_sd_m: of a fix per axis; None: that of a cell
    innovation_gate, fit_gate, ambiguity_veto: proposals of the source, off as there (Storms, L697, L800); what they
        refuse has `gate_probability` of happening by chance, or a rival one tenth as likely
    resolve_prior: search a finer lattice where cells are wide against the prior, and count the change across a cell
    most_border_mass: `matched_fix` refuses a posterior that has more than this at the border of its window
    """

    noise_sd_uT: float = 0.1
    map_variance: bool = True
    use_prior: bool = True
    reach_sigmas: float = 4.0
    least_reach_m: float = 0.3
    most_reach_m: float = 6.0
    slice_half_m: float = 1.5
    least_sd_m: float | None = None
    innovation_gate: bool = False
    fit_gate: bool = False
    ambiguity_veto: bool = False
    gate_probability: float = 0.0027
    resolve_prior: bool = False
    most_border_mass: float = 1.0


class FixDiagnostics(NamedTuple):
    """misfit: least squared residual over variance of any cell, chi-square with `components` degrees of freedom
    best_misfit: that of the likeliest cell, prior and all
    peaks: local maxima of the posterior within three prior sigmas
    rival_log_ratio: how far the best of them more than three sigmas of the fix away is behind; inf if alone
    innovation_m: from the prior mean; squared_distance: that over its covariance
    border_mass: probability of the window's outermost cells
    """

    misfit: float
    best_misfit: float
    components: int
    peaks: int
    rival_log_ratio: float
    innovation_m: float
    squared_distance: float
    border_mass: float


class PositionFix(NamedTuple):
    """position_m (2,), covariance_m2 (2, 2); `refused` names the gate that advises against its use, or is None."""

    position_m: Array
    covariance_m2: Array
    diagnostics: FixDiagnostics
    refused: Refusal | None


def ml_fix(
    cells: MapCells, reading_uT: Array, mean_m: Array, covariance_m2: Array, settings: FixSettings
) -> PositionFix | None:
    """The likeliest cell given a reading (c,) and a Gaussian prior (2,), (2, 2); R by slices (Storms, L561-581).

    R leaves the prior out, so that it does not correlate with P (Storms, L579). None where nothing is known.
    """
    posterior = _search(cells, reading_uT, mean_m, covariance_m2, settings)
    if posterior is None:
        return None
    position_m = posterior.position_m(posterior.best)
    R_m2 = _slice_covariance_m2(posterior, settings)
    return _judged(posterior, position_m, R_m2, covariance_m2 + R_m2, mean_m, covariance_m2, settings)


def matched_fix(
    cells: MapCells, reading_uT: Array, mean_m: Array, covariance_m2: Array, settings: FixSettings
) -> PositionFix | None:
    """Mean and covariance of the posterior over cells: a position in which the prior counts once. None as above."""
    posterior = _search(cells, reading_uT, mean_m, covariance_m2, settings)
    if posterior is None:
        return None
    position_m, spread_m2 = posterior.moments()
    return _judged(posterior, position_m, spread_m2, covariance_m2, mean_m, covariance_m2, settings)


def half_width_16_84(log_mass: Array, spacing_m: float) -> float:
    """Half the distance between the points with 16 % of a slice below and above them (Storms, L577-581).

    `log_mass` (n,), equally spaced, -inf where unknown. Each cell spreads its mass over its width. The source's mean
    cancels: ((mu - lo) + (hi - mu)) / 2.
    """
    mass = np.exp(log_mass - log_mass.max())
    below = np.concatenate([[0.0], np.cumsum(mass)]) / mass.sum()
    low, high = np.interp([_TAIL, 1.0 - _TAIL], below, spacing_m * np.arange(len(below)))
    return float(0.5 * (high - low))


def lever_arm_agrees(one: PositionFix, other: PositionFix, lever_m: Array, sigmas: float = 3.0) -> bool:
    """Whether two sensors' fixes are as far apart as the sensors are, (2,) from one to the other (Storms, L893)."""
    off_m = other.position_m - one.position_m - lever_m
    covariance_m2 = one.covariance_m2 + other.covariance_m2
    return bool(off_m @ np.linalg.solve(covariance_m2, off_m) <= sigmas**2)


def _search(
    cells: MapCells, reading_uT: Array, mean_m: Array, covariance_m2: Array, settings: FixSettings
) -> GridPosterior | None:
    half_m = search_half_m(covariance_m2, settings.reach_sigmas, settings.least_reach_m, settings.most_reach_m)
    return grid_posterior(
        cells,
        reading_uT,
        mean_m,
        covariance_m2,
        half_m,
        settings.noise_sd_uT,
        map_variance=settings.map_variance,
        use_prior=settings.use_prior,
        resolve_prior=settings.resolve_prior,
    )


def _slice_covariance_m2(posterior: GridPosterior, settings: FixSettings) -> Array:
    """(2, 2) diagonal: squared half widths of the likelihood along x and y through the best cell."""
    j, i = posterior.best
    spacing_m = posterior.cells.resolution_m
    least_m = spacing_m / np.sqrt(12.0) if settings.least_sd_m is None else settings.least_sd_m
    reach = max(1, round(settings.slice_half_m / spacing_m))
    slices = (posterior.log_likelihood[j, max(0, i - reach) : i + reach + 1],
              posterior.log_likelihood[max(0, j - reach) : j + reach + 1, i])  # fmt: skip
    return np.diag([max(half_width_16_84(each, spacing_m), least_m) ** 2 for each in slices])


def _judged(
    posterior: GridPosterior,
    position_m: Array,
    spread_m2: Array,
    innovation_covariance_m2: Array,
    mean_m: Array,
    prior_m2: Array,
    settings: FixSettings,
) -> PositionFix:
    off_m = position_m - mean_m
    peaks, rival = _rivals(posterior, position_m, spread_m2, mean_m, prior_m2)
    diagnostics = FixDiagnostics(
        float(posterior.misfit.min()),
        float(posterior.misfit[posterior.best]),
        posterior.cells.mean_uT.shape[2],
        peaks,
        rival,
        float(np.hypot(*off_m)),
        float(off_m @ np.linalg.solve(innovation_covariance_m2, off_m)),
        posterior.border_mass(),
    )
    return PositionFix(position_m, spread_m2, diagnostics, _refusal(diagnostics, settings))


def _rivals(
    posterior: GridPosterior, position_m: Array, spread_m2: Array, mean_m: Array, prior_m2: Array
) -> tuple[int, float]:
    """How many local maxima lie within three prior sigmas, and how far behind the best one elsewhere is."""
    peaks = local_maxima(posterior.log_posterior, within=12.0)
    r = posterior.cells.resolution_m
    place_m = np.asarray(posterior.cells.origin_m) + r * peaks[:, ::-1]
    inside = _squared_distance(place_m - mean_m, prior_m2) <= 9.0
    elsewhere = inside & (_squared_distance(place_m - position_m, spread_m2) > 9.0)
    heights = posterior.log_posterior[peaks[elsewhere, 0], peaks[elsewhere, 1]]
    behind = float(posterior.log_posterior.max() - heights.max()) if len(heights) else np.inf
    return int(inside.sum()), behind


def _squared_distance(off_m: Array, covariance_m2: Array) -> Array:
    return np.asarray(np.einsum("ni,ij,nj->n", off_m, np.linalg.inv(covariance_m2), off_m))


def _refusal(found: FixDiagnostics, settings: FixSettings) -> Refusal | None:
    """The first of the switched-on gates that a fix does not pass."""
    p = settings.gate_probability
    if settings.innovation_gate and found.squared_distance > chdtri(2, p):
        return "innovation"
    if settings.fit_gate and found.misfit > chdtri(found.components, p):
        return "fit"
    if settings.ambiguity_veto and found.rival_log_ratio < _AS_LIKELY:
        return "ambiguous"
    if found.border_mass > settings.most_border_mass:
        return "border"
    return None
