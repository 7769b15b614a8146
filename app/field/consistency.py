"""Is a survey consistent with the map of the others? Kuevor B14 (Kuevor, L904, L1631), whole and in segments.

The seed's rule asks for 96 % of errors within two predictive sds in every component. A perfectly calibrated map has
95.45 %, so beside the rule each component gets the probability of a coverage this low by chance, with as many
independent samples as the distance over which errors stay correlated allows; and since coverage says nothing of how far
outside an error is, their mean square is tested too. A stretch, or a survey, is called inconsistent when it fails the
rule *and* chance does not explain it.

The noise of a map is learned from all its surveys, so a bad one widens the sd it is judged by. Each survey is therefore
judged by sds brought down to what the errors of the other surveys show, where those are much smaller.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc, chdtrc

from app.field.change_point import find_change
from app.field.leave_one_out import HeldOut
from app.field.noise_calibration import NOMINAL_COVERAGE
from app.field.ranks import ranked_without
from app.field.spec import ComponentConsistency, ConsistencyReport, SegmentConsistency
from app.geometry import Array

__all__ = ["MIN_JUDGED", "check_consistency", "check_surveys"]

SEED_COVERAGE = 0.96
CHANCE = 1e-4
"""Below this probability a low coverage, or a large mean square, is no longer put down to chance."""

MIN_JUDGED = 20
SEGMENT_M = 10.0
ROBUST_SD = 1.4826
"""Sd of a Gaussian over the median of its absolute values."""
GENEROSITY = 1.5
"""Real errors have heavier tails than their median tells: sds come down to this many robust ones, no lower."""


def check_surveys(
    held_out: Mapping[str, HeldOut], names: tuple[str, ...], correlation_m: float
) -> dict[str, ConsistencyReport]:
    """The report of every survey, each judged by what the errors of the others show."""
    shown = _medians_of_others([np.abs(h.standardised) for h in held_out.values()])
    scales = np.clip(GENEROSITY * ROBUST_SD * shown, 1e-3, 1.0)
    return {
        survey_id: check_consistency(replace(own, sd_uT=own.sd_uT * scale), names, correlation_m)
        for (survey_id, own), scale in zip(held_out.items(), scales, strict=True)
    }


def _medians_of_others(values: Sequence[Array]) -> Array:
    """(s, c) per survey, the median of all others' values (n, c) together; infinite where the others have none."""
    own = np.array([len(each) for each in values])
    others = own.sum() - own
    middle = np.stack([np.maximum(others - 1, 0) // 2, others // 2], axis=1)
    medians = ranked_without(values, middle).mean(axis=1)
    return np.asarray(np.where(others[:, None] > 0, medians, np.inf))


def check_consistency(held_out: HeldOut, names: tuple[str, ...], correlation_m: float) -> ConsistencyReport:
    """The report of one survey, given its errors against the others' map and how far errors stay correlated."""
    judged = int(np.count_nonzero(held_out.judged))
    if judged < MIN_JUDGED:
        reason = f"{judged} of its samples are near another survey, {MIN_JUDGED} are needed: survey the area again"
        return ConsistencyReport("unjudged", None, judged, None, reason=reason)
    coverage, p_values, acceptable = _judge(held_out, np.flatnonzero(held_out.judged), correlation_m)
    error_uT, sd_uT = held_out.error_uT[held_out.judged], held_out.sd_uT[held_out.judged]
    components = tuple(
        ComponentConsistency(
            component=name,
            coverage_2sigma=float(coverage[c]),
            seed_2sigma_96=bool(coverage[c] >= SEED_COVERAGE),
            rmse_ut=float(np.sqrt(np.mean(np.square(error_uT[:, c])))),
            mean_sd_ut=float(np.mean(sd_uT[:, c])),
            p_value=float(p_values[c]),
        )
        for c, name in enumerate(names)
    )
    segments = _segments(held_out, correlation_m)
    consistent = acceptable and all(segment.consistent for segment in segments)
    return ConsistencyReport(
        status="consistent" if consistent else "inconsistent",
        seed_2sigma_96=all(component.seed_2sigma_96 for component in components),
        judged_samples=judged,
        nlpd=held_out.nlpd,
        components=components,
        segments=segments,
        change_point=find_change(held_out, names, correlation_m),
    )


def _segments(held_out: HeldOut, correlation_m: float) -> tuple[SegmentConsistency, ...]:
    """Stretches of about ten metres; those with too few judged samples are left out."""
    stretch = np.floor(held_out.path_m / SEGMENT_M).astype(np.int64)
    cuts = np.flatnonzero(np.diff(stretch)) + 1
    bounds = np.concatenate([[0], cuts, [len(stretch)]])
    segments = []
    for start, stop in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        indices = start + np.flatnonzero(held_out.judged[start:stop])
        if len(indices) >= MIN_JUDGED:
            coverage, _, acceptable = _judge(held_out, indices, correlation_m)
            segments.append(SegmentConsistency(start, stop, tuple(coverage.tolist()), acceptable))
    return tuple(segments)


def _judge(held_out: HeldOut, indices: NDArray[np.int64], correlation_m: float) -> tuple[Array, Array, bool]:
    """Coverage (c,) of the samples at `indices`, the probability (c,) of one as low if calibrated, and the verdict."""
    standardised = held_out.error_uT[indices] / held_out.sd_uT[indices]
    coverage = np.mean(np.abs(standardised) <= 2.0, axis=0)
    walked_m = held_out.path_m[indices[-1]] - held_out.path_m[indices[0]]
    independent = len(indices)
    if correlation_m > 0.0:
        independent = min(independent, 1.0 + walked_m / (2.0 * correlation_m))
    misses = (1.0 - coverage) * independent
    p_values = betainc(np.maximum(misses, 1e-9), independent - misses + 1.0, 1.0 - NOMINAL_COVERAGE)
    p_values = np.where(misses > 0.0, p_values, 1.0)
    mean_square = np.mean(np.square(standardised), axis=0)
    by_chance = (p_values >= CHANCE) & (chdtrc(independent, independent * mean_square) >= CHANCE)
    return coverage, p_values, bool(np.all((coverage >= SEED_COVERAGE) | by_chance))
