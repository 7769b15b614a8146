"""Different noise for different surveys: whose errors against the others are clearly larger, or smaller, than usual.

Of every survey the mean square of its errors against the map of the others, in predictive sds, says how noisy it is
beside the typical one. Few metres say little, so the logarithms are shrunk towards the typical survey by empirical
Bayes: their variance between surveys is what is left of the variance seen when that of sampling is taken off (method of
moments; Efron & Morris 1975). Surveys that are alike so keep one noise, while a phone in a bag, labels tapped
carelessly, or a field in the wrong unit count for less, in learning too. The factor is on the variances of all errors
of a survey: white, correlated and its offset.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from app.field.leave_one_out import HeldOutPrediction
from app.field.observations import STRETCH_M, Walk
from app.field.tile_fit import Learned
from app.geometry import Array

__all__ = ["clearly_differ", "noise_scales", "survey_noise_scales"]

FEWEST_SURVEYS = 3
"""Of two surveys that disagree nobody knows which is wrong."""
KNOWN = 0.8
"""Judged are places where the others leave less than this share of the signal's variance open."""
CLEAR = float(np.log(2.0))
"""No factor this near to one is worth learning and fitting again."""
LARGEST_LOG = float(np.log(1e4))


def survey_noise_scales(learned: Learned, walks: Sequence[Walk], predicted: HeldOutPrediction) -> dict[str, float]:
    """Survey id -> factor on its noise variance, of those that can be judged."""
    hyper = learned.hyper
    mean_uT, variance_ratio = predicted.mean_uT, predicted.variance_ratio
    noise_ratio = hyper.bias_ratio + hyper.walk_ratio + hyper.white_ratio
    correlated_m = 2.0 * (hyper.length_m + (hyper.walk_length_m if hyper.walk_ratio else 0.0))
    squared, freedom = {}, {}
    for walk in walks:
        name = walk.survey_id
        judged = variance_ratio[name].mean(axis=1) < KNOWN
        error = (walk.field_uT - learned.ambient_uT - mean_uT[name])[judged] / hyper.signal_sd_uT
        standardised = np.square(error) / (variance_ratio[name][judged] + noise_ratio)
        squared[name] = float(standardised.mean()) if len(error) else np.nan
        freedom[name] = error.shape[1] * len(error) * STRETCH_M / correlated_m
    return noise_scales(squared, freedom)


def noise_scales(squared: Mapping[str, float], freedom: Mapping[str, float]) -> dict[str, float]:
    """Survey id -> factor, of those that can be judged; all 1 where none is clearly different.

    squared: mean square of standardised errors; freedom: independent errors it was averaged over.
    """
    judged = [name for name in squared if freedom[name] >= 1.0]
    if len(judged) < FEWEST_SURVEYS:
        return {}
    seen, n = np.array([squared[name] for name in judged]), np.array([freedom[name] for name in judged])
    log_seen = np.log(np.maximum(seen, 1e-12))
    log_scale = _shrunk(np.clip(log_seen - np.median(log_seen), -LARGEST_LOG, LARGEST_LOG), 2.0 / n)
    if np.max(np.abs(log_scale)) < CLEAR:
        log_scale = np.zeros(len(judged))
    return dict(zip(judged, np.exp(log_scale).tolist(), strict=True))


def clearly_differ(before: Mapping[str, float], after: Mapping[str, float]) -> bool:
    """Whether some survey is taken to be much noisier, or much less so, than before."""
    return any(abs(np.log(scale / before.get(name, 1.0))) >= CLEAR for name, scale in after.items())


def _shrunk(values: Array, variance: Array) -> Array:
    """(s,) values of known sampling variance, drawn towards zero as far as they do not differ by more than it."""
    between = max(float(np.average(np.square(values) - variance, weights=1.0 / variance)), 0.0)
    return np.asarray(values * between / (between + variance))
