"""`isodyn evaluate`: how good maps and fixes are on a folder of real walks, as tables and as JSON."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from app.cli.plain_json import write_json
from app.cli.progress import bars

if TYPE_CHECKING:
    from app.services.cross_validate_maps import CrossValidation
    from app.services.evaluate_walks import Evaluation

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
    folds: Annotated[
        bool, typer.Option("--folds", help="judge windows of every walk: each fifth of the walks held out once")
    ] = False,
    disc_m: Annotated[float, typer.Option("--disc", min=0, help="radius of the prior disc, metres; 0: none")] = 20.0,
    bias_sd_uT: Annotated[float, typer.Option("--bias-sd", min=0, help="of the phone's constant offset, uT")] = 2.0,
    step_scale_sd: Annotated[float, typer.Option("--scale-sd", min=0, help="of the scale of its steps")] = 0.12,
    drift_sd: Annotated[float, typer.Option("--drift-sd", min=0, help="of its heading's drift, rad/m")] = 0.003,
    processes: Annotated[int, typer.Option(min=1, max=2, help="child processes")] = 2,
) -> None:
    """Hold one walk in five out, map the rest, locate windows of the held-out walks, and print how good that is."""
    from app.cli.evaluation_tables import print_evaluation
    from app.errors import IsodynError
    from app.field.spec import MapSpec
    from app.services.cross_validate_maps import cross_validate_maps
    from app.services.evaluate_walks import EvaluationPlan, evaluate_walks
    from app.services.evaluation_summary import summarise
    from app.services.judge_windows import PHONE, Question

    for name, value, known in (
        ("components", components, ("vector", "level", "norm")),
        ("composition", composition, ("raw", "demeaned")),
    ):
        if value not in known:
            raise typer.BadParameter(f"{value} is not one of {', '.join(known)}", param_hint=f"--{name}")
    options = replace(PHONE, bias_sd_uT=bias_sd_uT, step_scale_sd=step_scale_sd, heading_drift_sd_rad_per_m=drift_sd)
    question = Question(
        window_lengths_m=tuple(lengths_m),
        composition=composition,  # type: ignore[arg-type]
        disc_m=disc_m,
        options=options,
    )
    plan = EvaluationPlan(
        spec=MapSpec(components=components, resolution_m=resolution_m, hard_iron=False),  # type: ignore[arg-type]
        question=question,
        session_bias=session_bias,
        rehearse=rehearse,
        folds=folds,
        processes=processes,
    )
    errors = Console(stderr=True)
    try:
        with bars(errors) as told:
            judge = cross_validate_maps if maps else evaluate_walks
            found: Evaluation | CrossValidation = judge(directory, plan, told)
    except IsodynError as error:
        errors.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from error
    summaries = [] if maps else summarise(found)  # type: ignore[arg-type]
    console = Console()
    print_evaluation(console if console.is_terminal else Console(width=_FILE_WIDTH), found, summaries, disc_m)
    if json_file is not None:
        document = {"evaluation": asdict(found), "summaries": [asdict(summary) for summary in summaries]}
        write_json(json_file, document)
