"""The sd of one further measurement about the map, as held-out errors show it.

A likelihood believes its model of the noise; errors of surveys against the map of the others show what a new survey
will meet: labels off by a metre, hard iron, a phone in another hand. The noise is set so that two predictive sds cover
as much of them as a Gaussian should (Kuevor B14 asks the same of every log); each survey is scored with the noise the
*other* surveys show, so that the score stays honest.

A quantile of few surveys covers less of the next one than of them: of n exchangeable draws it would cover 1 / (n + 1)
less. Samples of one survey err together, so surveys are what is counted; part of each lies beyond, not all or nothing.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["LEAST_SHARE", "NOMINAL_COVERAGE", "noise_sd_by_survey", "noise_sd_shown"]

NOMINAL_COVERAGE = 0.9545
FEWEST_SURVEYS = 3
FEWEST_SAMPLES = 200
UNSEEN_SHARE = 0.15
"""Of one survey's weight by which the level is raised; found by walks of a mall left out, whole, five times over."""
HIGHEST_LEVEL = 0.97
LEAST_SHARE = 0.7
"""Of the believed sd: where surveys are sparse, an overstated latent variance explains errors that noise made."""


def noise_sd_shown(needed_uT2: Sequence[Array], believed_sd_uT: Array) -> Array:
    """(c,) noise sd that covers held-out errors as it should; what was believed, when too few were held out.

    needed_uT2: per survey (n, c), the noise variance with which each judged error would lie at two predictive sds:
    `error^2 / 4 - latent variance`. The answer is at least LEAST_SHARE of what was believed.
    """
    judged = [needed for needed in needed_uT2 if len(needed)]
    if len(judged) < FEWEST_SURVEYS or sum(map(len, judged)) < FEWEST_SAMPLES:
        return believed_sd_uT
    variance_uT2 = np.quantile(np.concatenate(judged), _level([len(needed) for needed in judged]), axis=0)
    return np.asarray(np.sqrt(np.maximum(variance_uT2, np.square(LEAST_SHARE * believed_sd_uT))))


def _level(samples: Sequence[int]) -> float:
    """The share of errors seen that should lie within two sds for NOMINAL_COVERAGE of a new survey's."""
    surveys = sum(samples) ** 2 / sum(n**2 for n in samples)
    return min(NOMINAL_COVERAGE * (1.0 + UNSEEN_SHARE / surveys), HIGHEST_LEVEL)


def noise_sd_by_survey(needed_uT2: Mapping[str, Array], believed_sd_uT: Array) -> dict[str, Array]:
    """Survey id -> (c,) noise sd that the other surveys show, of one sort for all surveys."""
    judged = {survey_id: needed for survey_id, needed in needed_uT2.items() if len(needed)}
    if not judged:
        return dict.fromkeys(needed_uT2, believed_sd_uT)
    everything = np.sort(np.concatenate(list(judged.values())).T.copy())  # (c, n): rows are searched
    least_uT2 = np.square(LEAST_SHARE * believed_sd_uT)
    shown = {}
    for survey_id in needed_uT2:
        own = judged.get(survey_id, needed_uT2[survey_id])
        if len(judged) - (len(own) > 0) < FEWEST_SURVEYS or everything.shape[1] - len(own) < FEWEST_SAMPLES:
            shown[survey_id] = believed_sd_uT
            continue
        level = _level([len(needed) for other, needed in judged.items() if other != survey_id])
        columns = zip(everything, own.T, strict=True)
        variance_uT2 = np.array([_quantile_without(level, *both) for both in columns])
        shown[survey_id] = np.sqrt(np.maximum(variance_uT2, least_uT2))
    return shown


def _quantile_without(share: float, everything: Array, own: Array) -> float:
    """The quantile of the sorted values (n,) but for `own` (m,), which are among them."""
    taken = np.searchsorted(everything, np.sort(own)) + _repeats(np.sort(own))
    rank = share * (len(everything) - len(own) - 1)
    below = int(rank)
    # The k-th of the others lies as many places further on as own ones lie before it.
    places = [k + int(np.searchsorted(taken - np.arange(len(taken)), k, side="right")) for k in (below, below + 1)]
    low, high = everything[np.minimum(places, len(everything) - 1)]
    return float(low + (rank - below) * (high - low))


def _repeats(ordered: Array) -> NDArray[np.int64]:
    """(m,) how many equal values stand before each of the sorted ones."""
    first = np.searchsorted(ordered, ordered)
    return np.asarray(np.arange(len(ordered)) - first)
