"""The honest score of a map: every survey predicted from all the others.

A map is a sum of its surveys' evidence, so the map of the others is a subtraction, tile by tile; hyper-parameters
and ambient field are the whole map's.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from app.field.blending import add_at_points
from app.field.observations import Walk, walk_bounds
from app.field.spec import Score
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
        return self.error_uT[self.judged] / self.sd_uT[self.judged]

    @property
    def nlpd(self) -> float:
        """Mean negative log predictive density of the judged samples, per sample and component."""
        log_sd = np.log(self.sd_uT[self.judged])
        return float(np.mean(0.5 * np.log(2 * np.pi) + log_sd + 0.5 * np.square(self.standardised)))


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
    judged = {name: h for name, h in held_out.items() if h.judged.any()}
    if not judged:
        return None
    error_uT = np.concatenate([h.error_uT[h.judged] for h in judged.values()])
    measured = np.concatenate([measured_uT[name][h.judged] for name, h in judged.items()])
    standardised = np.concatenate([h.standardised for h in judged.values()])
    counts = np.array([np.count_nonzero(h.judged) for h in judged.values()])
    mean_square_uT2 = np.mean(np.square(error_uT), axis=0)
    norm_error_uT = np.linalg.norm(measured, axis=1) - np.linalg.norm(measured - error_uT, axis=1)
    return Score(
        rmse_ut=tuple(np.sqrt(mean_square_uT2).tolist()),
        coverage_2sigma=tuple(np.mean(np.abs(standardised) <= 2.0, axis=0).tolist()),
        nlpd=float(counts @ [h.nlpd for h in judged.values()] / counts.sum()),
        held_out_samples=len(error_uT),
        rmse_vec_ut=float(np.sqrt(mean_square_uT2.sum())),
        rmse_of_norm_ut=float(np.sqrt(np.mean(np.square(norm_error_uT)))),
        sharpness_ut=tuple(np.concatenate([h.sd_uT[h.judged] for h in judged.values()]).mean(axis=0).tolist()),
    )


def error_correlation_m(held_out: Mapping[str, HeldOut]) -> float:
    """Distance walked over which errors against the map stay correlated: the integral of their autocorrelation.

    The median over surveys, so that one bad survey does not set it; 0 when no survey can be judged.
    """
    lengths = [length for h in held_out.values() if (length := _integral_length(h)) is not None]
    return float(np.median(lengths)) if lengths else 0.0


def _integral_length(held_out: HeldOut) -> float | None:
    """Integral of one survey's autocorrelation up to its first zero; None when too little of it is judged."""
    path_m = held_out.path_m[held_out.judged]
    cell = np.floor(path_m / LAG_M).astype(np.int64)
    cells, first = np.unique(cell, return_index=True)
    if len(cells) < 8:
        return None
    z = np.add.reduceat(np.clip(held_out.standardised, -5.0, 5.0), first, axis=0)
    z /= np.diff(np.append(first, len(cell)))[:, None]
    padded = np.full((cells[-1] - cells[0] + 1, z.shape[1]), np.nan)
    padded[cells - cells[0]] = z
    power = np.nanmean(np.square(padded))
    if power == 0.0:
        return 0.0
    total = 0.5
    for lag in range(1, min(int(MAX_LAG_M / LAG_M), len(padded) - 1)):
        products = padded[lag:] * padded[:-lag]
        if np.isnan(products).all() or (rho := float(np.nanmean(products) / power)) <= 0.0:
            break
        total += rho
    return total * LAG_M
