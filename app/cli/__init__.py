"""The `isodyn` command: one file per command, heavy imports inside it, so that `isodyn --help` is quick."""

import typer

from app.cli import (
    audit,
    backup,
    calibrate,
    client,
    demo,
    doctor,
    evaluate,
    evaluate_tracks,
    keys,
    migrate,
    serve,
    view,
)
from app.cli.default_group import DEFAULT, DefaultGroup

__all__ = ["main"]

main = typer.Typer(
    name="isodyn",
    help="Magnetic maps of buildings: walk in, position out.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode="markdown",
)
main.command()(serve.serve)
main.command()(serve.worker)
main.command()(migrate.migrate)
main.command()(demo.demo)
main.command()(client.ingest)
main.command()(calibrate.calibrate)
main.command()(client.locate)
main.command()(client.export)
main.command()(view.view)
evaluations = typer.Typer(cls=DefaultGroup, help="How good maps and fixes are on real walks, and tracks.")
evaluations.command(DEFAULT, hidden=True, epilog="`isodyn evaluate tracks` follows walks step by step.")(
    evaluate.evaluate
)
evaluations.command("tracks")(evaluate_tracks.tracks)
main.add_typer(evaluations, name="evaluate")
main.add_typer(keys.commands, name="keys")
main.command()(audit.audit)
main.command()(doctor.doctor)
main.command()(backup.backup)
main.command()(backup.restore)
main.command()(backup.clean)
main.command()(serve.openapi)
