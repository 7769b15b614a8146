"""Judged windows as rates with standard errors that respect that the windows of one walk are alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from app.services.acceptance import Acceptance, reachable_acceptance
from app.services.evaluate_walks import Evaluation
from app.services.judge_windows import SHARES, Answer, JudgedWindow, Place
from app.services.rates import Rate, rate

__all__ = ["Reliability", "Summary", "TechniqueSummary", "summarise"]

NEAR_M, FAR_M = 2.0, 5.0
PERCENTILES = (50, 75, 90)
TECHNIQUES = ("ml", "ml_floor_known", "mlr", "abl", "posterior", "strongest", "prior_disc")
STATUSES = ("fix", "ambiguous", "inconsistent", "unmapped")


@dataclass(frozen=True, slots=True)
class TechniqueSummary:
    """One technique over a set of windows. Errors are of the windows it answered; a wrong floor is infinitely wrong."""

    available: Rate
    right_floor: Rate
    within_2_m: Rate
    within_5_m: Rate
    error_percentiles_m: dict[str, float]


@dataclass(frozen=True, slots=True)
class Reliability:
    """Share of windows whose truth lies on the believed floor within the radius that is to hold a share of it.

    held      per share of SHARES, in percent; `stated`: what they should be, the floor's probability counted in
    windows   over which: not those called unmapped, whose radii are those of the whole floor
    """

    held: dict[str, Rate]
    stated: dict[str, float]
    windows: int


@dataclass(frozen=True, slots=True)
class Summary:
    """All windows of one length, or those over mapped ground.

    right_floor          the posterior's strongest floor is the right one
    status               share of windows by status
    fix_within_5_m       of the windows answered with status "fix", those on the right floor within 5 m
    acceptance           what could be accepted by the strongest mode's probability, right within 5 m; `disc_acceptance`
                         the same of those that were told a prior position
    reliability          of the posterior's radii; `disc_reliability`: with a prior position, on the right floor
    """

    length_m: float
    covered_only: bool
    windows: int
    walks: int
    right_floor: Rate
    techniques: dict[str, TechniqueSummary]
    status: dict[str, Rate]
    disc_status: dict[str, Rate]
    fix_within_5_m: Rate
    disc_fix_within_5_m: Rate
    acceptance: Acceptance
    disc_acceptance: Acceptance
    reliability: Reliability
    disc_reliability: Reliability


def summarise(evaluation: Evaluation) -> list[Summary]:
    """For each window length: over all windows, and over those on mapped ground."""
    lengths = sorted({window.length_m for window in evaluation.windows})
    return [
        _summary([w for w in evaluation.windows if w.length_m == length_m and (w.covered or not covered)], covered)
        for length_m in lengths
        for covered in (False, True)
        if any(w.length_m == length_m and (w.covered or not covered) for w in evaluation.windows)
    ]


def _summary(windows: Sequence[JudgedWindow], covered_only: bool) -> Summary:
    answers = [(w.answer, _walk(w)) for w in windows]
    told = [(w.disc, _walk(w)) for w in windows if w.disc is not None]
    return Summary(
        length_m=windows[0].length_m,
        covered_only=covered_only,
        windows=len(windows),
        walks=len({_walk(w) for w in windows}),
        right_floor=_share(answers, lambda answer: answer.position.right_floor),
        techniques={name: _technique(windows, name) for name in TECHNIQUES},
        status=_statuses(answers),
        disc_status=_statuses(told),
        fix_within_5_m=_fixes_within_5_m(answers),
        disc_fix_within_5_m=_fixes_within_5_m(told),
        acceptance=_acceptance(answers),
        disc_acceptance=_acceptance(told),
        reliability=_reliability(answers),
        disc_reliability=_reliability(told),
    )


def _walk(window: JudgedWindow) -> str:
    return f"{window.floor_id}/{window.walk}"


Answers = Sequence[tuple[Answer, str]]  # each with the walk its window is of


def _share(answers: Answers, judge: Callable[[Answer], bool]) -> Rate:
    return rate([judge(answer) for answer, _ in answers], [walk for _, walk in answers])


def _statuses(answers: Answers) -> dict[str, Rate]:
    return {name: _share(answers, lambda answer, name=name: answer.status == name) for name in STATUSES}  # type: ignore[misc]


def _fixes_within_5_m(answers: Answers) -> Rate:
    fixes = [(answer, walk) for answer, walk in answers if answer.status == "fix"]
    return _share(fixes, lambda answer: answer.position.within(FAR_M))


def _acceptance(answers: Answers) -> Acceptance:
    return reachable_acceptance(
        [answer.confidence for answer, _ in answers],
        [answer.strongest.within(FAR_M) for answer, _ in answers],
        [walk for _, walk in answers],
    )


def _reliability(answers: Answers) -> Reliability:
    mapped = [(answer, walk) for answer, walk in answers if answer.status != "unmapped"]
    floor = float(np.mean([answer.floor_probability for answer, _ in mapped])) if mapped else np.nan
    held = {
        f"{100 * share:.0f}": _share(mapped, lambda answer, k=k: answer.holds(k))  # type: ignore[misc]
        for k, share in enumerate(SHARES)
    }
    return Reliability(held, {f"{100 * share:.0f}": share * floor for share in SHARES}, len(mapped))


def _technique(windows: Sequence[JudgedWindow], name: str) -> TechniqueSummary:
    answered: list[tuple[Place, str]] = []
    for window in windows:
        place: Place | None = getattr(window, name)
        if place is not None:
            answered.append((place, _walk(window)))
    walks = [walk for _, walk in answered]
    error_m = [place.error_m if place.right_floor else np.inf for place, _ in answered]
    percentiles = np.percentile(error_m, PERCENTILES, method="higher") if error_m else np.full(len(PERCENTILES), np.nan)
    return TechniqueSummary(
        available=rate([getattr(window, name) is not None for window in windows], [_walk(w) for w in windows]),
        right_floor=rate([place.right_floor for place, _ in answered], walks),
        within_2_m=rate([place.within(NEAR_M) for place, _ in answered], walks),
        within_5_m=rate([place.within(FAR_M) for place, _ in answered], walks),
        error_percentiles_m={f"p{q}": float(x) for q, x in zip(PERCENTILES, percentiles, strict=True)},
    )
