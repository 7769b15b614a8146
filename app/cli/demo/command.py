"""The `isodyn demo` command: make a world, show it to a server, judge the answers, leave the server up."""

import json
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from app.cli.demo.connection import Connection
    from app.cli.demo.journey import Answer, MappedFloor
    from app.cli.demo.report import Judged
    from app.cli.demo.server import DemoServer
    from app.cli.demo.world import World

__all__ = ["demo"]

HEATMAP_LAYERS = ("norm", "sd")
CANNOT, ABSURD = 2, 1  # exit codes


def demo(
    once: Annotated[bool, typer.Option("--once", help="exit when done, instead of leaving the server up")] = False,
    data: Annotated[
        Path | None,
        typer.Option(exists=True, file_okay=False, help="real traces instead: one folder of *.txt(.gz) per floor"),
    ] = None,
    output: Annotated[Path, typer.Option(file_okay=False, help="folder for data, pictures, report")] = Path(
        "demo-output"
    ),
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="port of the server [a free one]")] = None,
    width_m: Annotated[float, typer.Option(min=10, max=100, help="of the synthetic building, along x")] = 40.0,
    depth_m: Annotated[float, typer.Option(min=10, max=100, help="of the synthetic building, along y")] = 30.0,
    floors: Annotated[int, typer.Option(min=1, max=10, help="of the synthetic building")] = 2,
    windows: Annotated[int, typer.Option(min=4, max=2000, help="to ask; with --data, of each length")] = 80,
    seed: Annotated[int, typer.Option(min=0, help="the same seed makes the same building and walks")] = 2026,
) -> None:
    """Make a building, walk it, map it and locate unseen walks in it; then leave the server up."""
    from app.cli.demo.connection import Connection
    from app.cli.demo.server import DemoError, clean_folder, running_server
    from app.errors import IsodynError

    console = Console(highlight=False)
    try:
        with _terminated_like_interrupted(), clean_folder(output) as folder:
            shape = {"width_m": width_m, "depth_m": depth_m, "floors": floors}
            world = _world(console, data, windows, seed, shape)
            with running_server(folder, port) as server:
                with Connection(server) as api:
                    reasons = _show(console, api, world, folder)
                if not once:
                    _leave_up(console, server)
    except (DemoError, IsodynError) as error:
        Console(stderr=True, highlight=False).print(f"[red]the demo stopped:[/red] {error}", soft_wrap=True)
        raise typer.Exit(CANNOT) from error
    except KeyboardInterrupt:
        console.print("stopped")
        raise typer.Exit(130) from None
    if reasons:
        raise typer.Exit(ABSURD)


def _world(console: Console, data: Path | None, windows: int, seed: int, shape: dict[str, Any]) -> "World":
    with _bar(console, "walking" if data is None else "reading walks") as told:
        if data is not None:
            from app.cli.demo.traces import traces_world

            return traces_world(data, windows=windows, told=told)
        import numpy as np

        from app.cli.demo.synthetic import synthetic_world

        return synthetic_world(np.random.default_rng(seed), windows=windows, told=told, **shape)


def _show(console: Console, api: "Connection", world: "World", folder: Path) -> list[str]:
    """Upload, map, ask, print, draw. The reasons why the result is absurd, if it is."""
    from app.cli.demo import report as reporting
    from app.cli.demo.journey import ask, make_building, mapped_floors

    building_id, floor_ids = make_building(api, world)
    _map(console, api, world, floor_ids)
    floors = mapped_floors(api, world, floor_ids)
    with _bar(console, "locating") as told:
        answers = ask(api, building_id, world.questions, told)
    judged = reporting.judge(answers, floor_ids)
    console.print(*(f"[dim]{note}[/dim]" for note in world.notes), sep="\n")
    console.print(
        reporting.map_table(floors), *reporting.position_tables(judged), reporting.status_line(answers, judged)
    )
    document = reporting.report(world, floors, answers, judged)
    (folder / "report.json").write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")
    _draw(console, api, folder, floors, answers, judged)
    reasons = reporting.absurdities(world, floors, judged)
    for reason in reasons:
        console.print(f"[red]this cannot be right:[/red] {reason}")
    return reasons


def _map(console: Console, api: "Connection", world: "World", floor_ids: list[str]) -> None:
    """Upload every survey, then follow each floor's last job, which maps them all."""
    from app.cli.demo.journey import upload, wait_for_job

    with _progress(console) as progress:
        bar = progress.add_task("uploading", total=sum(len(floor.surveys) for floor in world.floors))
        jobs = [
            upload(api, floor_id, floor, lambda: progress.advance(bar))
            for floor_id, floor in zip(floor_ids, world.floors, strict=True)
        ]
        bars = [progress.add_task(f"mapping {floor.name}", total=100) for floor in world.floors]
        for job_id, each, floor in zip(jobs, bars, world.floors, strict=True):

            def told(percent: int, message: str, each: Any = each, name: str = floor.name) -> None:
                progress.update(each, completed=percent, description=f"mapping {name}: {message}")

            wait_for_job(api, job_id, told)


def _draw(
    console: Console,
    api: "Connection",
    folder: Path,
    floors: list["MappedFloor"],
    answers: list["Answer"],
    judged: list["Judged"],
) -> None:
    """The server's own pictures and pages of each map, and ours."""
    from app.cli.demo.pictures import draw_errors, draw_floor

    for floor in floors:
        stem = "".join(c if c.isalnum() else "-" for c in floor.name.lower())
        map_id = floor.map["id"]
        for layer in HEATMAP_LAYERS:
            picture = api.call("GET", f"/v1/maps/{map_id}/heatmap.png", params={"layer": layer}).content
            (folder / f"{stem}-heatmap-{layer}.png").write_bytes(picture)
        (folder / f"{stem}-view.html").write_bytes(api.call("GET", f"/v1/maps/{map_id}/view.html").content)
        draw_floor(folder / f"{stem}-fixes.png", floor, answers)
    draw_errors(folder / "errors.png", judged, f"{len(answers)} windows of unseen walks, any floor, no prior")
    names = sorted(path.name for path in folder.iterdir() if path.suffix in (".png", ".html", ".json"))
    console.print(f"written to {folder}: {', '.join(names)}", soft_wrap=True)


def _leave_up(console: Console, server: "DemoServer") -> None:
    """Say where the page is, and stay until the server ends or Ctrl-C."""
    from app.cli.demo.server import DemoError

    console.print(f"\n[bold]The server is up.[/bold] Page: {server.url}/view/   API: {server.url}/docs", soft_wrap=True)
    console.print(f"Sign in with the key [bold]{server.key}[/bold]   (Ctrl-C stops the server)", soft_wrap=True)
    try:
        code = server.process.wait()
    except KeyboardInterrupt:
        console.print("stopping the server")
        return
    raise DemoError(f"the server ended by itself with code {code}; see {server.log}")


@contextmanager
def _terminated_like_interrupted() -> Iterator[None]:
    """SIGTERM ends the demo as Ctrl-C does, so that its server is stopped too."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(),
        console=console,
    )  # fmt: skip


@contextmanager
def _bar(console: Console, description: str) -> Iterator[Callable[[int, int], None]]:
    with _progress(console) as progress:
        task = progress.add_task(description, total=None)
        yield lambda done, total: progress.update(task, completed=done, total=total)
