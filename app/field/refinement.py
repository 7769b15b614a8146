"""Whether a floor's walks may be refined: corrections of labels that carry their own proof.

Corrected walks agree better with one another whatever they are, also walks that never were in one building. Three
things prove a correction, and all are asked for:

- injection: smooth errors, known and added to all labels, come out again by more than half their variance;
- untouched walks, left out altogether, are more likely under the map of corrected walks than under that of walks as
  they are, their own errors of labels integrated out; and their mean absolute error does not rise;
- an unseen component: corrections found by the vertical component alone make the others agree better.

Standard errors take walks as independent, not samples (jackknife over walks).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from app.field.hard_iron import Cleaned
from app.field.hilbert_engine import estimate_by_hilbert
from app.field.label_errors import displacements
from app.field.measured import near_observations
from app.field.observations import Walk, observe
from app.field.others import FromOthers
from app.field.refinement_proof import (
    Gain,
    components_of,
    fall_of_error,
    gain_in_density,
    gain_of_unseen,
    predict_untouched,
    recovered_share,
)
from app.field.samples import Samples
from app.field.spec import MapSpec, Progress
from app.geometry import Array

__all__ = ["Refinement", "Untouched", "refine"]

STRETCH_M = 0.6
"""Coarser than maps are made from: neither labels nor fields bend over this, and all costs a third."""
COARSE_M = 1.0
LEAST_RECOVERED = 0.5


class Untouched(NamedTuple):
    """A walk as it was, left out, from corrected others: mean_uT and latent variance_uT2 (N, c) of every sample."""

    mean_uT: Array
    variance_uT2: Array


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """walks: with corrected labels; correction_rms_m: of every walk

    recovered_share: of the variance of injected errors, below zero when corrections add to them; None where no two
        walks meet. The gains, None likewise or where there is no second component:
    untouched_nats: log density of walks left out, per observation; untouched_error, unseen_error: share by which the
        mean absolute error falls
    untouched: what an honest score of the map is made of: labels that were corrected agree too well
    """

    walks: Mapping[str, Samples]
    correction_rms_m: Mapping[str, float]
    recovered_share: float | None
    untouched_nats: Gain | None
    untouched_error: Gain | None
    unseen_error: Gain | None
    untouched: Mapping[str, Untouched]

    @property
    def faults(self) -> list[str]:
        """What speaks against it."""
        if self.recovered_share is None or self.untouched_nats is None or self.untouched_error is None:
            return ["no two surveys come within a metre of each other"]
        found = []
        if not self.recovered_share > LEAST_RECOVERED:
            share = f"{self.recovered_share:.0%}"
            found.append(f"of known errors put into the labels only {share} of the variance come out again")
        if not self.untouched_nats.significant:
            found.append("walks that were left out are not predicted better, beyond chance")
        if self.untouched_error.value < 0.0:
            found.append("the error of walks that were left out rises")
        if self.unseen_error is None:
            found.append("there is no second component to judge by")
        elif not self.unseen_error.significant:
            found.append("components that were not looked at do not agree better, beyond chance")
        return found

    @property
    def worth_it(self) -> bool:
        return not self.faults

    def as_json(self) -> dict[str, object]:
        """Plain JSON: whether it is applied and why, the proofs, the size of every walk's correction."""
        gains = {
            "untouched_gain_nats": self.untouched_nats,
            "untouched_error_falls_by": self.untouched_error,
            "unseen_error_falls_by": self.unseen_error,
        }
        return {
            "applied": self.worth_it,
            "reason": "; ".join(self.faults) or "known errors come out again, and untouched walks and components gain",
            "recovered_share": self.recovered_share,
            **{name: gain.as_json() if gain else None for name, gain in gains.items()},
            "correction_rms_m": dict(self.correction_rms_m),
        }


def refine(cleaned: Cleaned, spec: MapSpec, progress: Progress) -> Refinement:
    """Walks with corrected labels, and the proof of it. Deterministic; about thirty times the work of a coarse fit.

    Raises what observing and fitting raise (InvalidInput, IncompatibleFrames).
    """
    walks = observe(cleaned.walks, spec.components, STRETCH_M)
    coarse = replace(spec, resolution_m=max(spec.resolution_m, COARSE_M), robust=False)
    state = estimate_by_hilbert(walks, cleaned, coarse, None, lambda f, text: progress(0.1 * f, text)).state
    assert state is not None
    learned, components = state.learned, components_of(walks)
    near = near_observations(walks, volume=False)
    progress(0.1, "correcting labels")
    found = displacements(walks, learned, components)
    progress(0.25, "correcting labels with known errors")
    recovered = recovered_share(walks, learned, components, found, near)
    progress(0.4, "correcting labels by one component")
    unseen = gain_of_unseen(walks, learned, components, near)
    before, after = predict_untouched(walks, learned, components, lambda f, text: progress(0.5 + 0.5 * f, text))
    return Refinement(
        walks={**cleaned.walks, **{w.survey_id: _corrected(cleaned.walks[w.survey_id], w, found) for w in walks}},
        correction_rms_m={name: float(np.sqrt(np.mean(np.sum(np.square(d), axis=1)))) for name, d in found.items()},
        recovered_share=recovered,
        untouched_nats=gain_in_density(walks, learned, before, after, near),
        untouched_error=fall_of_error(walks, before, after, near, components),
        unseen_error=unseen,
        untouched={w.survey_id: _of_samples(w, after[w.survey_id]) for w in walks},
    )


def _corrected(samples: Samples, walk: Walk, displacement_m: Mapping[str, Array]) -> Samples:
    by_m = _spread(walk, displacement_m[walk.survey_id])
    return replace(samples, p_building_m=samples.p_building_m + np.pad(by_m, ((0, 0), (0, 1))))


def _of_samples(walk: Walk, predicted: FromOthers) -> Untouched:
    return Untouched(_spread(walk, predicted.mean_uT), _spread(walk, predicted.variance_uT2))


def _spread(walk: Walk, values: Array) -> Array:
    """(N, k) for all samples of values (n, k) at the observations, linear between the middle samples of stretches."""
    index = np.arange(len(walk.stretch_of_sample))
    middle = np.bincount(walk.stretch_of_sample, index) / np.bincount(walk.stretch_of_sample)
    return np.column_stack([np.interp(index, middle, column) for column in values.T])
