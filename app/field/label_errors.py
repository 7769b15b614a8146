"""Corrections of a survey's labels: the smooth, small displacement that fits it best to the map of the others.

Of one walk, the residual against the others' map is `r = G d + e`: d (n, 2) the displacement of its labels, a Gaussian
process of the distance walked with sd LABEL_SD_M and length LABEL_LENGTH_M; G the map's gradient; e what the map does
not know and the errors of measurements. What a map has learned as errors along a walk holds the errors of labels too,
so how much of it remains beside them is chosen by the likelihood of all residuals. Gauss-Newton: each sweep starts at
the labels corrected so far, with the others' map corrected as well.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from app.field.hyperparameters import Hyperparameters
from app.field.observations import Walk
from app.field.others import FromOthers, predict_from_others
from app.field.tile_fit import Learned
from app.geometry import Array

__all__ = ["LABEL_SD_M", "LARGEST_M", "displacements", "fit_labels", "label_prior", "moved"]

LABEL_SD_M, LABEL_LENGTH_M, LARGEST_M = 0.5, 7.0, 1.0
"""Sd per axis, correlation length along the path and hard bound of a correction."""
SWEEPS = 2
NOISE_SHARES = (1.0, 0.5, 0.25, 0.125)
"""Of the learned errors of measurements, what may remain when labels explain the rest."""
MOST_OBSERVATIONS = 2000
"""Longer walks stay as they are."""


class LabelFit(NamedTuple):
    """displacement_m (n, 2); log_likelihood of the residuals, but for a constant."""

    displacement_m: Array
    log_likelihood: float


def displacements(walks: Sequence[Walk], learned: Learned, seen: Sequence[int]) -> dict[str, Array]:
    """Survey id -> (n, 2) what to add to its labels, at most LARGEST_M, by the components `seen` of all walks."""
    found = {walk.survey_id: np.zeros((len(walk), 2)) for walk in walks}
    names = set(found)
    for _ in range(SWEEPS):
        predicted = predict_from_others(moved(walks, found), learned, names)
        trials = []
        for share in NOISE_SHARES:
            fits = {
                w.survey_id: fit_labels(w, predicted[w.survey_id], found[w.survey_id], learned.hyper, share, seen)
                for w in walks
            }
            trials.append((sum(fit.log_likelihood for fit in fits.values()), fits))
        _, best = max(trials, key=lambda trial: trial[0])
        found = {name: _bounded(fit.displacement_m) for name, fit in best.items()}
    return found


def moved(walks: Sequence[Walk], displacement_m: Mapping[str, Array]) -> list[Walk]:
    """The walks with corrected labels; those not named stay."""
    return [
        replace(walk, position_m=walk.position_m + np.pad(displacement_m[walk.survey_id], ((0, 0), (0, 1))))
        if walk.survey_id in displacement_m
        else walk
        for walk in walks
    ]


def label_prior(path_m: Array) -> Array:
    """(n, q) functions of the distance walked: weights of variance one give a displacement along one axis, in metres.

    The process seen at knots half its length apart, between which it hardly bends.
    """
    knots = np.linspace(path_m[0], path_m[-1], 2 + int((path_m[-1] - path_m[0]) / (0.5 * LABEL_LENGTH_M)))
    among = np.linalg.cholesky(_smooth(knots, knots) + 1e-6 * np.eye(len(knots)))
    return LABEL_SD_M * np.asarray(solve_triangular(among, _smooth(knots, path_m), lower=True)).T


def _smooth(a_m: Array, b_m: Array) -> Array:
    return np.asarray(np.exp(-0.5 * np.square((a_m[:, None] - b_m[None]) / LABEL_LENGTH_M)))


def _bounded(displacement_m: Array) -> Array:
    length_m = np.linalg.norm(displacement_m, axis=1, keepdims=True)
    return np.asarray(displacement_m * np.minimum(1.0, LARGEST_M / np.maximum(length_m, 1e-12)))


def fit_labels(
    walk: Walk, others: FromOthers, start_m: Array, hyper: Hyperparameters, share: float, seen: Sequence[int]
) -> LabelFit:
    """The most likely displacement of one walk when `share` of the learned errors remains, linearised at start_m.

    The part of it that all components share, R (n, n) in units of each one's signal variance, is factored once.
    """
    columns = list(seen)
    signal = np.broadcast_to(hyper.signal_sd_uT, walk.field_uT.shape[1])[columns]  # a potential has one for all
    slope = others.gradient_uT_per_m[:, columns] / signal[:, None]
    residual = (walk.field_uT - others.mean_uT)[:, columns] / signal + np.einsum("ncd,nd->nc", slope, start_m)
    latent = np.mean(others.variance_uT2[:, columns] / np.square(signal), axis=1)
    factor = cho_factor(_noise(walk, latent, hyper, share), lower=True)
    prior = label_prior(walk.path_m)
    q, c = prior.shape[1], len(columns)
    design = np.concatenate([slope[:, :, d, None] * prior[:, None] for d in (0, 1)], axis=2)  # (n, c, 2q)
    weighed = cho_solve(factor, np.concatenate([design.reshape(len(walk), -1), residual], axis=1))
    weighed_design, weighed_target = weighed[:, : c * 2 * q].reshape(design.shape), weighed[:, c * 2 * q :]
    precision = np.eye(2 * q) + np.einsum("ncp,ncq->pq", design, weighed_design, optimize=True)
    pull = np.einsum("ncp,nc->p", design, weighed_target, optimize=True)
    of_weights = cho_factor(precision, lower=True)
    weights = cho_solve(of_weights, pull)
    log_det = 2.0 * (np.log(np.diagonal(of_weights[0])).sum() + c * np.log(np.diagonal(factor[0])).sum())
    fitted = float(np.sum(residual * weighed_target) - pull @ weights)
    return LabelFit(np.column_stack([prior @ weights[:q], prior @ weights[q:]]), -0.5 * (log_det + fitted))


def _noise(walk: Walk, latent: Array, hyper: Hyperparameters, share: float) -> Array:
    """(n, n) covariance of the residuals without errors of labels, over the signal's variance."""
    apart_m = np.abs(walk.path_m[:, None] - walk.path_m[None])
    latent_sd = np.sqrt(np.maximum(latent, 0.0))
    unknown = np.outer(latent_sd, latent_sd) * np.exp(-apart_m / hyper.length_m)
    own = hyper.walk_ratio * np.exp(-apart_m / hyper.walk_length_m) + hyper.white_ratio * np.eye(len(walk))
    return np.asarray(unknown + share * own + hyper.bias_ratio_of(walk.survey_id))
