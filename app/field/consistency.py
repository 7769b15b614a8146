"""Is a survey consistent with the map of the others? Kuevor B14 (Kuevor, L904, L1631), whole and in segments.

The seed's rule asks for 96 % of errors within two predictive sds in every component. A perfectly calibrated map has
95.45 %, so beside the rule each component gets the probability of a coverage this low by chance, with as many
independent samples as the distance over which errors stay correlated allows. A stretch, or a survey, is called
inconsistent when it fails the rule *and* chance does not explain it.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import betainc

from app.field.leave_one_out import HeldOut
from app.field.spec import ComponentConsistency, ConsistencyReport, SegmentConsistency
from app.geometry import Array

__all__ = ["MIN_JUDGED", "check_consistency"]

SEED_COVERAGE = 0.96
NOMINAL_COVERAGE = 0.9545
CHANCE = 1e-3
"""Below this probability a low coverage is no longer put down to chance."""

MIN_JUDGED = 20
SEGMENT_M = 10.0


def check_consistency(held_out: HeldOut, names: tuple[str, ...], correlation_m: float) -> ConsistencyReport:
    """The report of one survey, given its errors against the others' map and how far errors stay correlated."""
    judged = int(np.count_nonzero(held_out.judged))
    if judged < MIN_JUDGED:
        reason = f"{judged} of its samples are near another survey, {MIN_JUDGED} are needed: survey the area again"
        return ConsistencyReport("unjudged", None, judged, None, reason=reason)
    coverage, p_values = _judge(held_out, np.flatnonzero(held_out.judged), correlation_m)
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
    consistent = _acceptable(coverage, p_values) and all(segment.consistent for segment in segments)
    return ConsistencyReport(
        status="consistent" if consistent else "inconsistent",
        seed_2sigma_96=all(component.seed_2sigma_96 for component in components),
        judged_samples=judged,
        nlpd=held_out.nlpd,
        components=components,
        segments=segments,
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
            coverage, p_values = _judge(held_out, indices, correlation_m)
            acceptable = _acceptable(coverage, p_values)
            segments.append(SegmentConsistency(start, stop, tuple(coverage.tolist()), acceptable))
    return tuple(segments)


def _judge(held_out: HeldOut, indices: NDArray[np.int64], correlation_m: float) -> tuple[Array, Array]:
    """Coverage (c,) of the samples at `indices`, and the probability (c,) of one as low or lower if calibrated."""
    standardised = held_out.error_uT[indices] / held_out.sd_uT[indices]
    coverage = np.mean(np.abs(standardised) <= 2.0, axis=0)
    walked_m = held_out.path_m[indices[-1]] - held_out.path_m[indices[0]]
    independent = len(indices)
    if correlation_m > 0.0:
        independent = min(independent, 1.0 + walked_m / (2.0 * correlation_m))
    misses = (1.0 - coverage) * independent
    p_values = betainc(np.maximum(misses, 1e-9), independent - misses + 1.0, 1.0 - NOMINAL_COVERAGE)
    return coverage, np.where(misses > 0.0, p_values, 1.0)


def _acceptable(coverage: Array, p_values: Array) -> bool:
    return bool(np.all((coverage >= SEED_COVERAGE) | (p_values >= CHANCE)))
