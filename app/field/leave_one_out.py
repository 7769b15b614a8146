"""The honest score of a map: every survey predicted from all the others.

A map is a sum of its surveys' evidence, so the map of the others is a subtraction, tile by tile; hyper-parameters
and ambient field are the whole map's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.field.blending import add_at_points
from app.field.observations import Walk, walk_bounds
from app.field.spec import Score
from app.field.tally import Tally, means_of_places, standardised, tally
from app.field.tile_fit import HeldOutPart
from app.field.tiles import Lattice, Tile
from app.geometry import Array

__all__ = ["HeldOut", "HeldOutPrediction", "error_correlation_m", "score"]

LAG_M = 0.25
MAX_LAG_M = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """A survey against the map of the others.

    error_uT, sd_uT (N, c): measured minus predicted, and the predictive sd (noise included), of every sample
    judged (N,): samples near enough to another survey to be judged
    path_m (N,): distance walked
    """

    error_uT: Array
    sd_uT: Array
    judged: NDArray[np.bool_]
    path_m: Array

    @property
    def standardised(self) -> Array:
        """(J, c) errors of the judged samples in predictive sds."""
        return np.asarray(standardised(self.error_uT, self.sd_uT, self.judged))

    def tally(self, bounds: NDArray[np.int64] | None = None) -> Tally:
        """Over the runs of samples between bounds (r + 1,), or over all."""
        runs = np.array([0, len(self.judged)]) if bounds is None else bounds
        return tally(self.error_uT, self.sd_uT, self.judged, self.path_m, runs)


class HeldOutPrediction:
    """Predictions at every walk's observations from the other walks, gathered tile by tile."""

    def __init__(self, lattice: Lattice, walks: Sequence[Walk], variances: int) -> None:
        self._lattice = lattice
        self._points_m = np.concatenate([walk.position_m for walk in walks])
        self._bounds = dict(zip((walk.survey_id for walk in walks), pairwise(walk_bounds(walks)), strict=True))
        self._mean_uT = np.zeros((len(self._points_m), walks[0].field_uT.shape[1]))
        self._variance_ratio = np.ones((len(self._points_m), variances))

    @property
    def mean_uT(self) -> dict[str, Array]:
        """Survey id -> (n, c) about the ambient field."""
        return {survey_id: self._mean_uT[start:stop] for survey_id, (start, stop) in self._bounds.items()}

    @property
    def variance_ratio(self) -> dict[str, Array]:
        """Survey id -> (n, v) variance of the latent field over the signal's."""
        return {survey_id: self._variance_ratio[start:stop] for survey_id, (start, stop) in self._bounds.items()}

    def add(self, tile: Tile, inside: NDArray[np.int64], part: HeldOutPart) -> None:
        """What one tile predicts, at the observations (indices among all of them) it answers; nothing, if it cannot."""
        if len(part.mean_uT):
            corner_m = np.array([self._lattice.answers_between(axis, tile) for axis in (0, 1)])
            where = self._points_m, inside, corner_m, self._lattice.ramp_m
            add_at_points(self._mean_uT, part.mean_uT, 0.0, *where)
            add_at_points(self._variance_ratio, part.variance_ratio, 1.0, *where)


def score(held_out: Mapping[str, HeldOut], measured_uT: Mapping[str, Array]) -> Score | None:
    """Over all judged samples of all surveys; None when no survey comes near another.

    measured_uT: survey id -> (N, c) the samples' features, of which the norm is taken (Kuevor B12, B13).
    """
    tallies = [h.tally() for h in held_out.values()]
    total = Tally(*(np.concatenate(each) for each in zip(*tallies, strict=True)))
    if not total.samples.any():
        return None
    total = total.whole()
    samples = int(total.samples[0])
    of_norm = sum(_squared_norm_error(measured_uT[name], h.error_uT, h.judged) for name, h in held_out.items())
    return Score(
        rmse_ut=tuple(np.sqrt(total.squared_uT2[0] / samples).tolist()),
        coverage_2sigma=tuple((total.within[0] / samples).tolist()),
        nlpd=total.nlpd,
        held_out_samples=samples,
        rmse_vec_ut=float(np.sqrt(total.squared_uT2.sum() / samples)),
        rmse_of_norm_ut=float(np.sqrt(of_norm / samples)),
        sharpness_ut=tuple((total.sd_uT[0] / samples).tolist()),
    )


@njit(cache=True)
def _squared_norm_error(measured_uT: Array, error_uT: Array, judged: NDArray[np.bool_]) -> float:
    """Sum over the judged samples of the squared difference of the norms measured and predicted."""
    total = 0.0
    for i in range(len(judged)):
        if judged[i]:
            measured, predicted = 0.0, 0.0
            for c in range(error_uT.shape[1]):
                measured += measured_uT[i, c] ** 2
                predicted += (measured_uT[i, c] - error_uT[i, c]) ** 2
            total += (np.sqrt(measured) - np.sqrt(predicted)) ** 2
    return total


def error_correlation_m(held_out: Mapping[str, HeldOut]) -> float:
    """Distance walked over which errors against the map stay correlated: the integral of their autocorrelation.

    The median over surveys, so that one bad survey does not set it; 0 when no survey can be judged.
    """
    lengths = [length for h in held_out.values() if (length := _integral_length(h)) is not None]
    return float(np.median(lengths)) if lengths else 0.0


def _integral_length(held_out: HeldOut) -> float | None:
    """Integral of one survey's autocorrelation up to its first zero; None when too little of it is judged."""
    path_m = held_out.path_m[held_out.judged]
    if not len(path_m):
        return None
    cell = np.floor(path_m / LAG_M).astype(np.int64)
    cell -= cell[0]
    cells = int(cell[-1]) + 1
    clipped = np.clip(held_out.standardised, -5.0, 5.0)
    z, count = means_of_places(clipped, cell, np.ones(len(cell), dtype=np.bool_), cells)
    known = count > 0
    if np.count_nonzero(known) < 8:
        return None
    power = float(np.mean(np.square(z[known])))
    if power == 0.0:
        return 0.0
    return float(_correlated_lags(z, known, power, min(int(MAX_LAG_M / LAG_M), cells - 1))) * LAG_M


@njit(cache=True)
def _correlated_lags(z: Array, known: NDArray[np.bool_], power: float, most: int) -> float:
    """Half of one, and the sum of the autocorrelations of cells (n, c) at lags below `most`, up to their first zero."""
    total = 0.5
    for lag in range(1, most):
        product, count = 0.0, 0
        for i in range(lag, len(z)):
            if known[i] and known[i - lag]:
                count += z.shape[1]
                for c in range(z.shape[1]):
                    product += z[i, c] * z[i - lag, c]
        if count == 0 or product <= 0.0:
            break
        total += product / count / power
    return total
