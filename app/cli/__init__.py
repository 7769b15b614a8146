"""The `isodyn` command: one file per command, heavy imports inside it, so that `isodyn --help` is quick."""

import typer

from app.cli import client, demo, doctor, evaluate, keys, serve, view

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
main.command()(demo.demo)
main.command()(client.ingest)
main.command()(client.locate)
main.command()(client.export)
main.command()(view.view)
main.command()(evaluate.evaluate)
main.add_typer(keys.commands, name="keys")
main.command()(doctor.doctor)
main.command()(serve.openapi)
