"""What `isodyn evaluate` prints: maps against walks, and windows as rates with their standard errors."""

import math
from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.table import Table

from app.field.spec import Score
from app.services.cross_validate_maps import CrossValidation
from app.services.evaluate_walks import Evaluation
from app.services.evaluation_summary import Reliability, Summary

__all__ = ["print_evaluation"]

_STATUSES = ("fix", "ambiguous", "inconsistent", "unmapped")


def print_evaluation(
    console: Console, evaluation: Evaluation | CrossValidation, summaries: Sequence[Summary], disc_m: float
) -> None:
    for name, reason in evaluation.unreadable.items():
        console.print(f"[yellow]{name} was left out:[/yellow] {reason}", highlight=False)
    if isinstance(evaluation, Evaluation) and evaluation.floors:
        console.print(_map_table(evaluation))
    if evaluation.floors:
        console.print(_held_out_table(evaluation))
    if summaries:
        for table in (_floor_table, _technique_table, _acceptance_table, _reliability_table):
            console.print(table(summaries))
    console.print(
        "± is one standard error, counting walks as independent, not windows. Covered: at least 80 % of the window "
        "within 1.5 m of a mapping walk. A wrong floor is an infinite error. Gain: NLPD of white noise less that of "
        "noise correlated along walks, on the same samples. Sd ranks errors: Spearman's correlation of the map's own "
        "sd with the size of the error. Reachable: the most windows, the surest first, of which nine in ten are right.",
        highlight=False,
    )
    if summaries and disc_m > 0.0:
        console.print(
            f"Prior disc: a position drawn evenly within {disc_m:g} m of the truth is told, with its sd, and the right "
            "floor alone searched.",
            highlight=False,
        )


def _map_table(evaluation: Evaluation) -> Table:
    table = Table(
        "floor", "walks", "samples", "RMSE, uT", "2-sigma coverage", "NLPD", title="Maps, each survey left out"
    )
    for floor in evaluation.floors:
        table.add_row(floor.floor_id, str(len(floor.mapping_walks)), *_score_cells(floor.leave_one_out))
    return table


def _score_cells(score: Score | None) -> tuple[str, ...]:
    if score is None:
        return ("0", "-", "-", "-")
    return (
        f"{score.held_out_samples:,}",
        " / ".join(f"{x:.2f}" for x in score.rmse_ut),
        " / ".join(f"{x:.3f}" for x in score.coverage_2sigma),
        f"{score.nlpd:.2f}",
    )


def _held_out_table(evaluation: Evaluation | CrossValidation) -> Table:
    table = Table("floor", "walks", "noise", "samples", "RMSE, uT", "robust sd, uT", "2-sigma coverage", "NLPD",
                  "sd ranks errors", title="Maps against held-out walks, within 1 m of a mapping walk")  # fmt: skip
    for floor in evaluation.floors:
        for noise, score in (("walk", floor.held_out), ("white", floor.held_out_white)):
            if score is None:
                continue
            table.add_row(
                floor.floor_id, str(score.walks), noise, f"{score.samples:,}",
                " / ".join(f"{x:.2f}" for x in score.rmse_ut),
                " / ".join(x.text(1) for x in score.robust_sd_ut),
                " / ".join(x.text(2) for x in score.coverage_2sigma),
                score.nlpd.text(2), score.rank_correlation.text(2),
            )  # fmt: skip
        if floor.nlpd_gain_over_white is not None:
            table.add_row(floor.floor_id, "", "gain", "", "", "", "", floor.nlpd_gain_over_white.text(3), "")
    return table


def _rows(summaries: Sequence[Summary]) -> Iterator[tuple[str, str, Summary]]:
    for summary in summaries:
        yield f"{summary.length_m:g} m", "covered" if summary.covered_only else "all", summary


def _floor_table(summaries: Sequence[Summary]) -> Table:
    table = Table("window", "ground", "windows", "walks", "right floor", *_STATUSES,
                  title="Floors and status (all floors searched, no prior)")  # fmt: skip
    for length, ground, summary in _rows(summaries):
        status = [str(summary.status[name]) for name in _STATUSES]
        table.add_row(length, ground, str(summary.windows), str(summary.walks), str(summary.right_floor), *status)
    return table


def _technique_table(summaries: Sequence[Summary]) -> Table:
    table = Table("window", "ground", "technique", "answers", "right floor", "within 2 m", "within 5 m",
                  "50 / 75 / 90 % of errors, m", title="Techniques (of the windows they answered)")  # fmt: skip
    for length, ground, summary in _rows(summaries):
        for name, technique in summary.techniques.items():
            percentiles = " / ".join(_metres(x) for x in technique.error_percentiles_m.values())
            table.add_row(
                length, ground, name.replace("_", " "), str(technique.available), str(technique.right_floor),
                str(technique.within_2_m), str(technique.within_5_m), percentiles,
            )  # fmt: skip
    return table


def _acceptance_table(summaries: Sequence[Summary]) -> Table:
    table = Table("window", "ground", "searched", "fixes", "of them within 5 m", "reachable", "of them within 5 m",
                  "at probability", title="Accepted windows")  # fmt: skip
    for length, ground, summary in _rows(summaries):
        for searched, status, right, reachable in (
            ("all floors", summary.status, summary.fix_within_5_m, summary.acceptance),
            ("prior disc", summary.disc_status, summary.disc_fix_within_5_m, summary.disc_acceptance),
        ):
            least = "-" if reachable.least_confidence is None else f"{reachable.least_confidence:.2f}"
            table.add_row(length, ground, searched, str(status["fix"]), str(right), str(reachable.accepted),
                          str(reachable.right), least)  # fmt: skip
    return table


def _reliability_table(summaries: Sequence[Summary]) -> Table:
    table = Table("window", "ground", "searched", "windows", "50 %", "68 %", "90 %", "95 %",
                  title="Truth within the radii, of windows not called unmapped (in brackets: expected, the floor's "
                  "probability counted in)")  # fmt: skip
    for length, ground, summary in _rows(summaries):
        for searched, found in (("all floors", summary.reliability), ("prior disc", summary.disc_reliability)):
            table.add_row(length, ground, searched, str(found.windows), *_reliability_cells(found))
    return table


def _reliability_cells(found: Reliability) -> list[str]:
    return [f"{held} ({found.stated[share]:.2f})" if found.windows else "-" for share, held in found.held.items()]


def _metres(x: float) -> str:
    return "-" if math.isnan(x) else "∞" if math.isinf(x) else f"{x:.1f}"
