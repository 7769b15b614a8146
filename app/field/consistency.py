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
from app.field.tally import Tally, count_below
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
    scales = _scales(list(held_out.values()))
    if scales is None:
        return {survey_id: check_consistency(own, names, correlation_m) for survey_id, own in held_out.items()}
    return {
        survey_id: check_consistency(replace(own, sd_uT=own.sd_uT * scale), names, correlation_m)
        for (survey_id, own), scale in zip(held_out.items(), scales, strict=True)
    }


def _scales(surveys: Sequence[HeldOut]) -> Array | None:
    """(s, c) factors on the sds of every survey; None when all are one, which counting tells without any median."""
    least = 1.0 / (GENEROSITY * ROBUST_SD)
    slight = np.array([count_below(least, h.error_uT, h.sd_uT, h.judged) for h in surveys])
    own = np.array([np.count_nonzero(h.judged) for h in surveys])
    others = own.sum() - own
    if np.all(slight.sum(axis=0) - slight <= (np.maximum(others, 1)[:, None] - 1) // 2):
        return None
    shown = _medians_of_others([np.abs(h.standardised) for h in surveys])
    return np.asarray(np.clip(GENEROSITY * ROBUST_SD * shown, 1e-3, 1.0))


def _medians_of_others(values: Sequence[Array]) -> Array:
    """(s, c) per survey, the median of all others' values (n, c) together; infinite where the others have none."""
    own = np.array([len(each) for each in values])
    others = own.sum() - own
    middle = np.stack([np.maximum(others - 1, 0) // 2, others // 2], axis=1)
    medians = ranked_without(values, middle).mean(axis=1)
    return np.asarray(np.where(others[:, None] > 0, medians, np.inf))


def check_consistency(held_out: HeldOut, names: tuple[str, ...], correlation_m: float) -> ConsistencyReport:
    """The report of one survey, given its errors against the others' map and how far errors stay correlated."""
    bounds = _segment_bounds(held_out.path_m)
    runs = held_out.tally(bounds)
    judged = int(runs.samples.sum())
    if judged < MIN_JUDGED:
        reason = f"{judged} of its samples are near another survey, {MIN_JUDGED} are needed: survey the area again"
        return ConsistencyReport("unjudged", None, judged, None, reason=reason)
    whole, heard = runs.whole(), np.flatnonzero(runs.samples >= MIN_JUDGED)
    both = Tally(*(np.concatenate(each) for each in zip(whole, runs.at(heard), strict=True)))
    coverage, p_values, verdicts = (each.tolist() for each in _judge(both, correlation_m))
    rmse_uT, mean_sd_uT = np.sqrt(whole.squared_uT2[0] / judged).tolist(), (whole.sd_uT[0] / judged).tolist()
    passed = [covered >= SEED_COVERAGE for covered in coverage[0]]
    columns = zip(names, coverage[0], passed, rmse_uT, mean_sd_uT, p_values[0], strict=True)
    starts, stops = bounds[heard].tolist(), bounds[heard + 1].tolist()
    segments = zip(starts, stops, map(tuple, coverage[1:]), verdicts[1:], strict=True)
    return ConsistencyReport(
        status="consistent" if all(verdicts) else "inconsistent",
        seed_2sigma_96=all(passed),
        judged_samples=judged,
        nlpd=whole.nlpd,
        components=tuple(ComponentConsistency(*column) for column in columns),
        segments=tuple(SegmentConsistency(*segment) for segment in segments),
        change_point=find_change(held_out, names, correlation_m),
    )


def _segment_bounds(path_m: Array) -> NDArray[np.int64]:
    """(s + 1,) of stretches of about ten metres."""
    stretch = np.floor(path_m / SEGMENT_M)
    return np.concatenate([[0], np.flatnonzero(np.diff(stretch)) + 1, [len(path_m)]])


def _judge(runs: Tally, correlation_m: float) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Of runs of samples, coverage (r, c), the probability (r, c) of one as low if calibrated, and verdicts (r,)."""
    count = runs.samples[:, None]
    coverage, mean_square = runs.within / count, runs.squared / count
    independent = count
    if correlation_m > 0.0:
        independent = np.minimum(count, 1.0 + np.diff(runs.path_m) / (2.0 * correlation_m))
    misses = (1.0 - coverage) * independent
    p_values = betainc(np.maximum(misses, 1e-9), independent - misses + 1.0, 1.0 - NOMINAL_COVERAGE)
    p_values = np.where(misses > 0.0, p_values, 1.0)
    by_chance = (p_values >= CHANCE) & (chdtrc(independent, independent * mean_square) >= CHANCE)
    return (
        coverage,
        np.asarray(p_values, np.float64),
        np.asarray(np.all((coverage >= SEED_COVERAGE) | by_chance, axis=1)),
    )
