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

from app.field.ranks import ranked_without
from app.geometry import Array

__all__ = ["LEAST_SHARE", "NEW", "NOMINAL_COVERAGE", "noise_sd_by_survey", "noise_sd_shown"]

NOMINAL_COVERAGE = 0.9545
NEW = "a new survey"
"""Which has no errors yet: the others are all there are."""
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
    surveys = {str(number): needed for number, needed in enumerate(needed_uT2)}
    return noise_sd_by_survey({NEW: np.zeros((0, len(believed_sd_uT)))} | surveys, believed_sd_uT)[NEW]


def noise_sd_by_survey(needed_uT2: Mapping[str, Array], believed_sd_uT: Array) -> dict[str, Array]:
    """Survey id -> (c,) noise sd that the other surveys show; for a survey of no judged error, that all show.

    The share of errors that should lie within two sds is raised for NOMINAL_COVERAGE of a new survey's.
    """
    own = np.array([len(needed) for needed in needed_uT2.values()])
    others, squares = own.sum() - own, np.sum(own**2) - own**2
    enough = (np.count_nonzero(own) - (own > 0) >= FEWEST_SURVEYS) & (others >= FEWEST_SAMPLES)
    if not enough.any():
        return dict.fromkeys(needed_uT2, believed_sd_uT)
    share = np.minimum(NOMINAL_COVERAGE * (1.0 + UNSEEN_SHARE * squares / np.maximum(others, 1) ** 2), HIGHEST_LEVEL)
    rank = share * np.maximum(others - 1, 0)
    below = rank.astype(np.int64)
    low, high = np.moveaxis(ranked_without(list(needed_uT2.values()), below[:, None] + [0, 1]), 1, 0)
    variance_uT2 = low + (rank - below)[:, None] * (high - low)
    shown_sd_uT = np.sqrt(np.maximum(variance_uT2, np.square(LEAST_SHARE * believed_sd_uT)))
    return {
        survey_id: sd_uT if known else believed_sd_uT
        for survey_id, sd_uT, known in zip(needed_uT2, shown_sd_uT, enough.tolist(), strict=True)
    }
