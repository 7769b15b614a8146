"""Judged tracks as rates and percentiles by filter, with standard errors that count walks as independent."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from app.services.followed_walks import ToldWhat
from app.services.map_scores import Estimate
from app.services.rates import Rate, rate
from app.services.track_scores import JudgedTrack

__all__ = ["AT_M", "ENDS_WITHIN_M", "FilterSummary", "Nees", "nees_band", "summarise_tracks"]

PERCENTILES = (50, 75, 90, 95)
ENDS_WITHIN_M = (1.0, 2.0, 5.0)
AT_M = 30
"""Metres walked after which a track should have converged."""

DRAWS = 400

Tracks = Sequence[JudgedTrack]


@dataclass(frozen=True, slots=True)
class Nees:
    """Of metres said with "converged" on the right floor: mean (two, if consistent), median (1.39), and an interval.

    It holds 95 % of the means of as many independent values as there are walks. Metres of a walk hang together,
    but a walk is worth one value at least: the interval is rather too wide. Infinite ones are counted, not averaged.
    """

    mean: Estimate | None
    median: float | None
    band: tuple[float, float] | None
    walks: int
    infinite: int

    @property
    def consistent(self) -> bool:
        return self.mean is not None and self.band is not None and self.band[0] <= self.mean.value <= self.band[1]


@dataclass(frozen=True, slots=True)
class FilterSummary:
    """One filter over a set of walks.

    ends_within, end_median_m   at the end of the walk, whatever the filter says of itself
    along_m                     percentiles of the error at each metre from convergence on (if told: from the start)
    converged                   share of walks that ever do; `converged_m`, `converged_s`: median and 90 % of those
    claims_ends, claims_metres  share of walks' ends, of metres, that are said with "converged"; `false_ends`,
                                `false_metres`: share of those farther off than a limit, or on a wrong floor
    lost                        of the walks that converged, those that do not end so
    at_30_m                     of walks that are long enough, those converged and within the least limit after AT_M
    """

    filter: str
    told: ToldWhat
    covered_only: bool
    walks: int
    ends_within: dict[str, Rate]
    end_median_m: Estimate | None
    along_m: dict[str, float]
    converged: Rate
    converged_m: tuple[float, float] | None
    converged_s: tuple[float, float] | None
    claims_ends: Rate
    claims_metres: Rate
    false_ends: dict[str, Rate]
    false_metres: dict[str, Rate]
    lost: Rate
    at_30_m: Rate
    floor_changes: int
    floor_changes_found: Rate
    floor_changes_made: int
    nees: Nees
    cpu_ms: float


def summarise_tracks(tracks: Tracks, false_beyond_m: Sequence[float]) -> list[FilterSummary]:
    """Over all walks and over covered ones, filter by filter; once, where all walks are covered."""
    names = list(dict.fromkeys(track.filter for track in tracks))
    out = []
    for covered_only in (True,) if all(track.covered for track in tracks) else (False, True):
        for name in names:
            chosen = [t for t in tracks if t.filter == name and (t.covered or not covered_only)]
            if chosen:
                out.append(_summary(chosen, covered_only, tuple(false_beyond_m)))
    return out


def _summary(tracks: Tracks, covered_only: bool, limits_m: tuple[float, ...]) -> FilterSummary:
    found = [t for t in tracks if t.converged_m is not None]
    claimed = [t for t in tracks if t.end_state == "converged"]
    long = [t for t in tracks if len(t.error_m) > AT_M]
    changed = [t for t in tracks if t.floor_changes]
    return FilterSummary(
        filter=tracks[0].filter,
        told=tracks[0].told,
        covered_only=covered_only,
        walks=len(tracks),
        ends_within={f"{x:g}": _share(tracks, lambda t, x=x: t.end_error_m <= x) for x in ENDS_WITHIN_M},  # type: ignore[misc]
        end_median_m=_drawn(tracks, lambda chosen: _median([t.end_error_m for t in chosen])),
        along_m=_along(tracks),
        converged=_share(tracks, lambda t: t.converged_m is not None),
        converged_m=_middle_and_most([t.converged_m for t in found if t.converged_m is not None]),
        converged_s=_middle_and_most([t.converged_s for t in found if t.converged_s is not None]),
        claims_ends=_share(tracks, lambda t: t.end_state == "converged"),
        claims_metres=_metres(tracks, lambda state, error_m: state == "converged", lambda state: True),
        false_ends={f"{x:g}": _share(claimed, lambda t, x=x: t.end_error_m > x) for x in limits_m},  # type: ignore[misc]
        false_metres={
            f"{x:g}": _metres(tracks, lambda _, error_m, x=x: error_m > x, lambda state: state == "converged")  # type: ignore[misc]
            for x in limits_m
        },
        lost=_share(found, lambda t: t.end_state != "converged"),
        at_30_m=_share(long, lambda t: t.state[AT_M] == "converged" and t.error_m[AT_M] <= limits_m[0]),
        floor_changes=sum(t.floor_changes for t in tracks),
        floor_changes_found=rate(
            [t.floor_changes_found / t.floor_changes for t in changed], [_walk(t) for t in changed]
        ),
        floor_changes_made=sum(t.floor_changes_made for t in tracks),
        nees=_nees(tracks),
        cpu_ms=_median([t.cpu_ms for t in tracks]),
    )


def _walk(track: JudgedTrack) -> str:
    return f"{track.floor_id}/{track.walk}"


def _share(tracks: Tracks, judge: Callable[[JudgedTrack], bool]) -> Rate:
    return rate([judge(track) for track in tracks], [_walk(track) for track in tracks])


def _metres(tracks: Tracks, judge: Callable[[str, float], bool], among: Callable[[str], bool]) -> Rate:
    """Share of the metres in some state."""
    judged = [
        (judge(state, error_m), _walk(track))
        for track in tracks
        for state, error_m in zip(track.state, track.error_m, strict=True)
        if among(state)
    ]
    return rate([each for each, _ in judged], [walk for _, walk in judged])


def _along(tracks: Tracks) -> dict[str, float]:
    error_m = [
        error_m
        for track in tracks
        for at_m, error_m in enumerate(track.error_m)
        if track.told != "nothing" or (track.converged_m is not None and at_m >= track.converged_m)
    ]
    values = np.percentile(error_m, PERCENTILES, method="higher") if error_m else np.full(len(PERCENTILES), np.nan)
    return {f"p{q}": float(x) for q, x in zip(PERCENTILES, values, strict=True)}


def _middle_and_most(values: Sequence[float]) -> tuple[float, float] | None:
    if not values:
        return None
    middle, most = np.percentile(values, [50, 90], method="higher")
    return float(middle), float(most)


def nees_band(walks: int) -> tuple[float, float]:
    """Holds 95 % of the means of so many independent chi-squares of two degrees of freedom."""
    return float(chi2.ppf(0.025, 2 * walks)) / walks, float(chi2.ppf(0.975, 2 * walks)) / walks


def _nees(tracks: Tracks) -> Nees:
    sure = {id(t): [x for state, x in zip(t.state, t.nees, strict=True) if state == "converged" and np.isfinite(x)]
            for t in tracks}  # fmt: skip
    metres = [pair for t in tracks for pair in zip(t.state, t.nees, strict=True)]
    infinite = sum(state == "converged" and math.isinf(x) for state, x in metres)
    told = [t for t in tracks if sure[id(t)]]
    if not told:
        return Nees(None, None, None, 0, infinite)
    mean = _drawn(told, lambda chosen: float(np.mean(np.concatenate([sure[id(t)] for t in chosen]))))
    return Nees(mean, _median([x for t in told for x in sure[id(t)]]), nees_band(len(told)), len(told), infinite)


def _median(values: Sequence[float]) -> float:
    return float(np.percentile(np.asarray(values), 50, method="higher"))


def _drawn(tracks: Tracks, statistic: Callable[[Tracks], float]) -> Estimate | None:
    """A statistic with the standard error that comes from drawing walks; None of an infinite one or of one walk."""
    if not tracks:
        return None
    rng, value = np.random.default_rng(0), statistic(tracks)
    draws = [statistic([tracks[k] for k in rng.integers(0, len(tracks), len(tracks))]) for _ in range(DRAWS)]
    with np.errstate(invalid="ignore"):
        error = float(np.std(draws)) if len(tracks) > 1 and np.isfinite(draws).all() else None
    return Estimate(value, error)
