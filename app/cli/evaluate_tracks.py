"""`isodyn evaluate tracks`: how well filters follow walks, real ones or synthetic ones, as tables, a plot and JSON."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from app.cli.plain_json import write_json
from app.cli.progress import bars

__all__ = ["tracks"]

_FILE_WIDTH = 200
_FOLDS = 5
FALSE_BEYOND_M = {"real": (5.0,), "synthetic": (1.0, 3.0)}


def tracks(
    directory: Annotated[
        Path | None,
        typer.Argument(
            exists=True,
            file_okay=False,
            help="one folder per floor, walks of indoor-location-2020 in each; not needed with --synthetic",
        ),
    ] = None,
    synthetic: Annotated[
        int, typer.Option("--synthetic", min=0, help="walks of 60 m in an analytic building of four floors")
    ] = 0,
    fold: Annotated[int, typer.Option("--fold", min=1, max=_FOLDS, help="which fifth of the walks to hold out")] = 5,
    folds: Annotated[bool, typer.Option("--folds", help="hold every fifth of the walks out in its turn")] = False,
    all_floors: Annotated[
        bool, typer.Option("--all-floors", help="search all floors, not only the walk's own")
    ] = False,
    json_file: Annotated[
        Path | None, typer.Option("--json", dir_okay=False, help="also write every track here")
    ] = None,
    plot_file: Annotated[
        Path | None, typer.Option("--plot", dir_okay=False, help="also draw error curves here (.png)")
    ] = None,
    resolution_m: Annotated[
        float | None, typer.Option("--resolution", min=0.1, help="cell of the maps, metres; 1, synthetic 0.25")
    ] = None,
    session_bias: Annotated[
        bool, typer.Option(help="take out the hard iron that mapping walks show for a session")
    ] = True,
    particles: Annotated[int, typer.Option(min=100, max=1_000_000, help="of the bootstrap particle filter")] = 20_000,
    seed: Annotated[int, typer.Option(min=0, help="of the filters, and of the synthetic building and its walks")] = 0,
    processes: Annotated[int, typer.Option(min=1, max=2, help="child processes")] = 2,
) -> None:
    """Hold one walk in five out, map the rest, follow the held-out ones, and print how good each filter is."""
    if (directory is None) == (synthetic == 0):
        raise typer.BadParameter(
            "give a folder of walks, or --synthetic with a number of walks", param_hint="DIRECTORY"
        )
    from app.cli.tracks_tables import print_tracks
    from app.errors import IsodynError
    from app.field.spec import MapSpec
    from app.services.evaluate_tracks import TrackPlan, evaluate_tracks
    from app.services.track_summary import summarise_tracks
    from app.tracking.options import TrackOptions

    plan = TrackPlan(
        spec=MapSpec(resolution_m=resolution_m or (0.25 if synthetic else 1.0)),
        session_bias=session_bias,
        folds=tuple(range(_FOLDS)) if folds else (fold - 1,),
        all_floors=all_floors,
        particles=particles,
        seed=seed,
        processes=processes,
    )
    errors = Console(stderr=True)
    try:
        with bars(errors) as told:
            if directory is not None:
                found = evaluate_tracks(directory, plan, told)
            else:
                from app.synthetic.tracked_walks import SyntheticPlan, evaluate_synthetic_tracks

                plan = replace(plan, options=TrackOptions())
                found = evaluate_synthetic_tracks(SyntheticPlan(synthetic, seed=seed), plan, told)
    except IsodynError as error:
        errors.print(f"[red]{error}[/red]")
        raise typer.Exit(1) from error
    limits_m = FALSE_BEYOND_M["synthetic" if directory is None else "real"]
    summaries = summarise_tracks(found.tracks, limits_m)
    console = Console()
    print_tracks(console if console.is_terminal else Console(width=_FILE_WIDTH), found, summaries)
    if plot_file is not None:
        from app.cli.tracks_plot import plot_tracks

        plot_tracks(plot_file, found.tracks)
    if json_file is not None:
        write_json(json_file, {"evaluation": asdict(found), "summaries": [asdict(each) for each in summaries]})
