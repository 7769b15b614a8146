"""What `isodyn evaluate tracks` prints: filters side by side, at the end of walks and along them."""

import math
from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from app.services.evaluate_tracks import TrackEvaluation
from app.services.rates import Rate
from app.services.track_scores import CHANGED_WITHIN_M
from app.services.track_summary import AT_M, ENDS_WITHIN_M, FilterSummary

__all__ = ["print_tracks"]

Summaries = Sequence[FilterSummary]


def print_tracks(console: Console, found: TrackEvaluation, summaries: Summaries) -> None:
    for name, reason in found.unreadable.items():
        console.print(f"[yellow]{name} was left out:[/yellow] {reason}", highlight=False)
    for table in (_error_table, _convergence_table, _claims_table, _consistency_table):
        console.print(table(summaries))
    console.print(
        "± is one standard error, counting walks as independent, not steps. Told: what of the truth a filter is "
        "given; those told the true start and heading are not to be compared with those that find themselves. "
        "Covered: at least 80 % of the walk within 1.5 m of a mapping walk. A wrong floor, or no answer, is an "
        "infinite error. Ends count whatever a filter says of itself; errors along the walk are those of every metre "
        "from convergence on (told: from the start). Claims: what is said in state converged; filters without states "
        "are taken to say so where their 95 % radius is at most 2.5 m. Lost: converged, but not at the end. NEES: "
        "squared error over its covariance while converged on the right floor, two on average for a filter that knows "
        "how good it is; in brackets what 95 % of the means of as many independent values as there are walks lie "
        "within; metres without error are said with a covariance of nothing, and not averaged.",
        highlight=False,
    )


def _table(title: str, *columns: str) -> Table:
    return Table("ground", "filter", "told", *columns, title=title)


def _head(summary: FilterSummary) -> tuple[str, str, str]:
    return "covered" if summary.covered_only else "all", summary.filter, summary.told


def _error_table(summaries: Summaries) -> Table:
    within = [f"within {x:g} m" for x in ENDS_WITHIN_M]
    table = _table("Errors", "walks", *(f"end {each}" for each in within), "median end, m",
                   "50 / 75 / 90 / 95 % along the walk, m")  # fmt: skip
    for each in summaries:
        ends = [str(share) for share in each.ends_within.values()]
        along = " / ".join(_metres(x) for x in each.along_m.values())
        table.add_row(*_head(each), str(each.walks), *ends, _median(each), along)
    return table


def _median(summary: FilterSummary) -> str:
    median = summary.end_median_m
    if median is None or not math.isfinite(median.value):
        return "-" if median is None else "∞"
    return median.text(1)


def _convergence_table(summaries: Summaries) -> Table:
    table = _table("Convergence, from an unknown start", "converged", "median / 90 % walked, m",
                   "median / 90 % passed, s", f"converged and right at {AT_M} m", "lost")  # fmt: skip
    for each in summaries:
        if each.told == "nothing":
            table.add_row(*_head(each), str(each.converged), _pair(each.converged_m), _pair(each.converged_s),
                          str(each.at_30_m), str(each.lost))  # fmt: skip
    return table


def _claims_table(summaries: Summaries) -> Table:
    limits = list(summaries[0].false_ends) if summaries else []
    columns = [f"{what}, beyond {x} m" for what in ("ends false", "metres false") for x in limits]
    table = _table("Claims: said in state converged", "ends", "metres", *columns, "cpu, ms per step")
    for each in summaries:
        false = [str(x) for x in (*each.false_ends.values(), *each.false_metres.values())]
        table.add_row(*_head(each), str(each.claims_ends), str(each.claims_metres), *false, f"{each.cpu_ms:.2f}")
    return table


def _consistency_table(summaries: Summaries) -> Table:
    table = _table("Floors and consistency", "floor changes", f"found within {CHANGED_WITHIN_M:g} m", "said",
                   "NEES mean (95 % of means)", "NEES median", "walks with NEES", "metres without error")  # fmt: skip
    for each in summaries:
        table.add_row(*_head(each), str(each.floor_changes), _share(each.floor_changes_found, each.floor_changes),
                      str(each.floor_changes_made), *_nees(each), str(each.nees.walks),
                      str(each.nees.infinite))  # fmt: skip
    return table


def _share(rate: Rate, of: int) -> str:
    return str(rate) if of else "-"


def _nees(summary: FilterSummary) -> tuple[str, str]:
    nees = summary.nees
    if nees.mean is None or nees.band is None or nees.median is None:
        return "-", "-"
    low, high = nees.band
    return f"{nees.mean.text(2)} ({low:.2f} - {high:.2f})", f"{nees.median:.2f}"


def _pair(pair: tuple[float, float] | None) -> str:
    return "-" if pair is None else f"{pair[0]:.1f} / {pair[1]:.1f}"


def _metres(x: float) -> str:
    return "-" if math.isnan(x) else "∞" if math.isinf(x) else f"{x:.1f}"
