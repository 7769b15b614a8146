"""`isodyn evaluate`: how good maps and fixes are on a folder of real walks, as tables and as JSON."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

if TYPE_CHECKING:
    from app.field.spec import Score
    from app.services.cross_validate_maps import CrossValidation
    from app.services.evaluate_walks import Evaluation
    from app.services.evaluation_summary import Summary

__all__ = ["evaluate"]

_FILE_WIDTH = 170


def evaluate(
    directory: Annotated[
        Path,
        typer.Argument(
            exists=True, file_okay=False, help="one folder per floor, walks of indoor-location-2020 in each"
        ),
    ],
    json_file: Annotated[Path | None, typer.Option("--json", help="also write every judged window here")] = None,
    lengths_m: Annotated[list[float], typer.Option("--length", help="window length, metres walked")] = [10, 20, 40],  # noqa: B006
    resolution_m: Annotated[float, typer.Option("--resolution", min=0.1, help="cell of the maps, metres")] = 1.0,
    components: Annotated[str, typer.Option(help="vector, level or norm")] = "vector",
    composition: Annotated[str, typer.Option(help="raw or demeaned")] = "raw",
    session_bias: Annotated[
        bool, typer.Option(help="take out the hard iron that mapping walks show for a session")
    ] = True,
    rehearse: Annotated[
        bool, typer.Option("--rehearse", help="judge by mapping walks only, to choose parameters")
    ] = False,
    maps: Annotated[
        bool, typer.Option("--maps", help="judge maps only, by every walk: each fifth of the walks held out once")
    ] = False,
    processes: Annotated[int, typer.Option(min=1, max=2, help="child processes")] = 2,
) -> None:
    """Hold one walk in five out, map the rest, locate windows of the held-out walks, and print how good that is."""
    from app.errors import IsodynError
    from app.field.spec import MapSpec
    from app.services.cross_validate_maps import cross_validate_maps
    from app.services.evaluate_walks import EvaluationPlan, evaluate_walks
    from app.services.evaluation_summary import summarise

    for name, value, known in (
        ("components", components, ("vector", "level", "norm")),
        ("composition", composition, ("raw", "demeaned")),
    ):
        if value not in known:
            raise typer.BadParameter(f"{value} is not one of {', '.join(known)}", param_hint=f"--{name}")
    plan = EvaluationPlan(
        window_lengths_m=tuple(lengths_m),
        spec=MapSpec(components=components, resolution_m=resolution_m, hard_iron=False),  # type: ignore[arg-type]
        composition=composition,  # type: ignore[arg-type]
        session_bias=session_bias,
        rehearse=rehearse,
        processes=processes,
    )
    errors = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        with Progress(*columns, console=errors) as progress:
            bars: dict[str, Any] = {}

            def told(stage: str, done: int, total: int) -> None:
                if stage not in bars:
                    bars[stage] = progress.add_task(stage, total=total)
                progress.update(bars[stage], completed=done)

            judge = cross_validate_maps if maps else evaluate_walks
            found: Evaluation | CrossValidation = judge(directory, plan, told)
    except IsodynError as error:
        errors.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from error
    summaries = [] if maps else summarise(found)  # type: ignore[arg-type]
    console = Console()
    _print(console if console.is_terminal else Console(width=_FILE_WIDTH), found, summaries)
    if json_file is not None:
        document = {"evaluation": asdict(found), "summaries": [asdict(summary) for summary in summaries]}
        json_file.write_text(json.dumps(_finite(document), indent=1, allow_nan=False) + "\n")


def _print(console: Console, evaluation: "Evaluation | CrossValidation", summaries: "list[Summary]") -> None:
    for name, reason in evaluation.unreadable.items():
        console.print(f"[yellow]{name} was left out:[/yellow] {reason}", highlight=False)
    if summaries:
        console.print(_map_table(evaluation))  # type: ignore[arg-type]
    console.print(_held_out_table(evaluation))
    if summaries:
        console.print(_floor_table(summaries))
        console.print(_technique_table(summaries))
        console.print(_honesty_table(summaries))
    console.print(
        "± is one standard error, counting walks as independent, not windows. Covered: at least 80 % of the window "
        "within 1.5 m of a mapping walk. A wrong floor is an infinite error. Gain: NLPD of white noise less that of "
        "noise correlated along walks, on the same samples. Sd ranks errors: Spearman's correlation of the map's own "
        "sd with the size of the error.",
        highlight=False,
    )


def _map_table(evaluation: "Evaluation") -> Table:
    table = Table(
        "floor", "walks", "samples", "RMSE, uT", "2-sigma coverage", "NLPD", title="Maps, each survey left out"
    )
    for floor in evaluation.floors:
        table.add_row(floor.floor_id, str(len(floor.mapping_walks)), *_score_cells(floor.leave_one_out))
    return table


def _score_cells(score: "Score | None") -> tuple[str, ...]:
    if score is None:
        return ("0", "-", "-", "-")
    return (
        f"{score.held_out_samples:,}",
        " / ".join(f"{x:.2f}" for x in score.rmse_ut),
        " / ".join(f"{x:.3f}" for x in score.coverage_2sigma),
        f"{score.nlpd:.2f}",
    )


def _held_out_table(evaluation: "Evaluation | CrossValidation") -> Table:
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


def _rows(summaries: "list[Summary]") -> "list[tuple[str, str, Summary]]":
    return [(f"{s.length_m:g} m", "covered" if s.covered_only else "all", s) for s in summaries]


def _floor_table(summaries: "list[Summary]") -> Table:
    table = Table("window", "ground", "windows", "walks", "right floor", "fix", "ambiguous", "inconsistent", "unmapped",
                  title="Floors and status (all floors searched, no prior)")  # fmt: skip
    for length, ground, summary in _rows(summaries):
        status = [str(summary.status[name]) for name in ("fix", "ambiguous", "inconsistent", "unmapped")]
        table.add_row(length, ground, str(summary.windows), str(summary.walks), str(summary.right_floor), *status)
    return table


def _technique_table(summaries: "list[Summary]") -> Table:
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


def _honesty_table(summaries: "list[Summary]") -> Table:
    table = Table("window", "ground", "truth in 68 % radius", "truth in 95 % radius", "fixes", "fixes within 5 m",
                  title="Stated uncertainty (right floor and within the stated radius)")  # fmt: skip
    for length, ground, summary in _rows(summaries):
        table.add_row(
            length, ground, str(summary.radius_68), str(summary.radius_95), str(summary.fix_within_5_m.windows),
            str(summary.fix_within_5_m),
        )  # fmt: skip
    return table


def _metres(x: float) -> str:
    return "-" if math.isnan(x) else "∞" if math.isinf(x) else f"{x:.1f}"


def _finite(value: Any) -> Any:
    """Plain JSON: null for what is infinite or not a number."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
