"""Judged windows as rates with standard errors that respect that the windows of one walk are alike."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from app.services.evaluate_walks import Evaluation, JudgedWindow, Place

__all__ = ["Rate", "Summary", "TechniqueSummary", "rate", "summarise"]

NEAR_M, FAR_M = 2.0, 5.0
PERCENTILES = (50, 75, 90)
TECHNIQUES = ("ml", "ml_floor_known", "mlr", "abl", "posterior")


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of windows with its standard error; share None when there is no window to take it of."""

    share: float | None
    standard_error: float | None
    windows: int

    def __str__(self) -> str:
        if self.share is None:
            return "-"
        error = "" if self.standard_error is None else f" ±{self.standard_error:.2f}".replace("0.", ".")
        return f"{self.share:.2f}".replace("0.", ".", 1 if self.share < 1 else 0) + error


@dataclass(frozen=True, slots=True)
class TechniqueSummary:
    """One technique over a set of windows. Errors are of the windows it answered; a wrong floor is infinitely wrong."""

    available: Rate
    right_floor: Rate
    within_2_m: Rate
    within_5_m: Rate
    error_percentiles_m: dict[str, float]


@dataclass(frozen=True, slots=True)
class Summary:
    """All windows of one length, or those over mapped ground.

    right_floor          the posterior's strongest floor is the right one
    status               share of windows by status
    radius_68, radius_95 share of windows whose true place lies on the believed floor within the stated radius
    fix_within_5_m       of the windows answered with status "fix", those on the right floor within 5 m
    """

    length_m: float
    covered_only: bool
    windows: int
    walks: int
    right_floor: Rate
    techniques: dict[str, TechniqueSummary]
    status: dict[str, Rate]
    radius_68: Rate
    radius_95: Rate
    fix_within_5_m: Rate


def rate(values: Sequence[bool], walks: Sequence[str]) -> Rate:
    """Share of true values; the standard error counts walks, not windows, as independent (linearised, n / (n - 1))."""
    if not values:
        return Rate(None, None, 0)
    share = float(np.mean(values))
    _, group = np.unique(np.asarray(walks), return_inverse=True)
    sums = np.bincount(group, weights=np.asarray(values, dtype=np.float64) - share)
    count = len(sums)
    if count < 2:
        return Rate(share, None, len(values))
    variance = count / (count - 1) * float(np.sum(np.square(sums))) / len(values) ** 2
    return Rate(share, float(np.sqrt(variance)), len(values))


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
    def share(judge: Callable[[JudgedWindow], bool], among: Sequence[JudgedWindow] = windows) -> Rate:
        return rate([judge(w) for w in among], [f"{w.floor_id}/{w.walk}" for w in among])

    fixes = [w for w in windows if w.status == "fix"]
    return Summary(
        length_m=windows[0].length_m,
        covered_only=covered_only,
        windows=len(windows),
        walks=len({(w.floor_id, w.walk) for w in windows}),
        right_floor=share(lambda w: w.posterior is not None and w.posterior.right_floor),
        techniques={name: _technique(windows, name) for name in TECHNIQUES},
        status={
            name: share(lambda w, name=name: w.status == name)  # type: ignore[misc]
            for name in ("fix", "ambiguous", "inconsistent", "unmapped")
        },
        radius_68=share(lambda w: w.posterior is not None and w.posterior.within(w.radius_68_m)),
        radius_95=share(lambda w: w.posterior is not None and w.posterior.within(w.radius_95_m)),
        fix_within_5_m=share(lambda w: w.posterior is not None and w.posterior.within(FAR_M), fixes),
    )


def _technique(windows: Sequence[JudgedWindow], name: str) -> TechniqueSummary:
    answered: list[tuple[Place, str]] = []
    for window in windows:
        place: Place | None = getattr(window, name)
        if place is not None:
            answered.append((place, f"{window.floor_id}/{window.walk}"))
    walks = [walk for _, walk in answered]
    error_m = [place.error_m if place.right_floor else np.inf for place, _ in answered]
    percentiles = np.percentile(error_m, PERCENTILES, method="higher") if error_m else np.full(len(PERCENTILES), np.nan)
    return TechniqueSummary(
        available=rate(
            [getattr(window, name) is not None for window in windows], [f"{w.floor_id}/{w.walk}" for w in windows]
        ),
        right_floor=rate([place.right_floor for place, _ in answered], walks),
        within_2_m=rate([place.within(NEAR_M) for place, _ in answered], walks),
        within_5_m=rate([place.within(FAR_M) for place, _ in answered], walks),
        error_percentiles_m={f"p{q}": float(x) for q, x in zip(PERCENTILES, percentiles, strict=True)},
    )
