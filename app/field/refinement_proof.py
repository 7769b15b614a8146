"""What proves a correction of labels: errors put in come out, walks left out gain, a component not looked at gains.

Gains have standard errors that take walks as independent, not samples (jackknife over walks).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from app.field.label_errors import LABEL_SD_M, displacements, fit_labels, label_prior, moved
from app.field.observations import Walk
from app.field.others import FromOthers, predict_from_others
from app.field.spec import Progress
from app.field.tile_fit import Learned
from app.geometry import Array

__all__ = [
    "Gain",
    "Near",
    "Predicted",
    "components_of",
    "fall_of_error",
    "gain_in_density",
    "gain_of_unseen",
    "predict_untouched",
    "recovered_share",
]

FOLDS = 4
INJECTED_SD_M = 0.35
"""Per axis, 0.5 m in the plane: beside the errors that are there already it stays within what is corrected."""
LEAST_WALKS = 4
CONFIDENCE = 0.975

Predicted = Mapping[str, FromOthers]
Near = Mapping[str, NDArray[np.bool_]]


class Gain(NamedTuple):
    """A mean or share over all walks, and its standard error."""

    value: float
    standard_error: float
    walks: int

    @property
    def significant(self) -> bool:
        """Above zero at 97.5 % (Student, walks less one)."""
        least = student.ppf(CONFIDENCE, max(self.walks - 1, 1)) * self.standard_error
        return bool(self.walks >= LEAST_WALKS and self.value > least)

    def as_json(self) -> dict[str, object]:
        return {
            "value": self.value, "standard_error": self.standard_error, "walks": self.walks,
            "significant": self.significant,
        }  # fmt: skip


def recovered_share(
    walks: Sequence[Walk], learned: Learned, components: Sequence[int], found: Mapping[str, Array], near: Near
) -> float | None:
    """Share of the variance of known errors that corrections take out again: by how they change when those are put in.

    Drawn as labels are taken to err, always in the same way: the same walks are judged alike.
    """
    rng = np.random.default_rng(0)
    injected = {}
    for walk in walks:
        functions = label_prior(walk.path_m)
        injected[walk.survey_id] = INJECTED_SD_M / LABEL_SD_M * functions @ rng.normal(size=(functions.shape[1], 2))
    answer = displacements(moved(walks, injected), learned, components)
    put_in, left = 0.0, 0.0
    for name, error_m in injected.items():
        put_in += float(np.sum(np.square(error_m[near[name]])))
        left += float(np.sum(np.square((error_m + answer[name] - found[name])[near[name]])))
    return 1.0 - left / put_in if put_in else None


def gain_of_unseen(walks: Sequence[Walk], learned: Learned, components: Sequence[int], near: Near) -> Gain | None:
    """Corrections by the last component, the vertical one, judged by the others; None of a map of norms."""
    *unseen, seen = components
    if not unseen:
        return None
    names = {walk.survey_id for walk in walks}
    corrected = moved(walks, displacements(walks, learned, (seen,)))
    before, after = (predict_from_others(each, learned, names) for each in (walks, corrected))
    return fall_of_error(walks, before, after, near, unseen)


def predict_untouched(
    walks: Sequence[Walk], learned: Learned, components: Sequence[int], progress: Progress
) -> tuple[dict[str, FromOthers], dict[str, FromOthers]]:
    """Every walk as it is, from others as they are and from others corrected without it: one in FOLDS left out."""
    before: dict[str, FromOthers] = {}
    after: dict[str, FromOthers] = {}
    for fold in range(min(FOLDS, len(walks))):
        progress(fold / FOLDS, "correcting labels without the walks that judge")
        judging = {walk.survey_id for walk in walks[fold::FOLDS]}
        mapping = [walk for walk in walks if walk.survey_id not in judging]
        found = displacements(mapping, learned, components) if mapping else {}
        for each, judged in ((walks, before), (moved(walks, found), after)):
            predicted = predict_from_others(each, learned, {walk.survey_id for walk in mapping})
            judged.update((name, predicted[name]) for name in judging)
    return before, after


def gain_in_density(
    walks: Sequence[Walk], learned: Learned, before: Predicted, after: Predicted, near: Near
) -> Gain | None:
    """Log density per observation near another walk, the walk's own errors of labels integrated out."""
    components = components_of(walks)

    def nats(walk: Walk, predicted: Predicted) -> float:
        still = np.zeros((len(walk), 2))
        return fit_labels(walk, predicted[walk.survey_id], still, learned.hyper, 1.0, components).log_likelihood

    judged = [walk for walk in walks if near[walk.survey_id].any()]
    gained = np.array([nats(walk, after) - nats(walk, before) for walk in judged])
    return _ratio(gained, np.array([float(near[walk.survey_id].sum()) for walk in judged]))


def fall_of_error(
    walks: Sequence[Walk], before: Predicted, after: Predicted, near: Near, components: Sequence[int]
) -> Gain | None:
    """Share by which the mean absolute error falls, near another walk."""
    columns = list(components)

    def errors_uT(predicted: Predicted) -> Array:
        of_walk = ((w.field_uT - predicted[w.survey_id].mean_uT)[near[w.survey_id]][:, columns] for w in walks)
        return np.array([np.abs(error_uT).sum() for error_uT in of_walk])

    one, other = errors_uT(before), errors_uT(after)
    return _ratio((one - other)[one > 0.0], one[one > 0.0])


def _ratio(gained: Array, total: Array) -> Gain | None:
    """sum(gained) / sum(total) over walks (k,), with its jackknife standard error; None of a single walk."""
    k = len(gained)
    if k < 2:
        return None
    without = (gained.sum() - gained) / (total.sum() - total)
    scatter = np.sqrt((k - 1) / k * np.sum(np.square(without - without.mean())))
    return Gain(float(gained.sum() / total.sum()), float(scatter), k)


def components_of(walks: Sequence[Walk]) -> tuple[int, ...]:
    return tuple(range(walks[0].field_uT.shape[1]))
