"""`isodyn migrate`: make or renew the schema, and end. What an upgrade does first, before anything new serves."""

import time
from typing import Annotated

import typer
from rich.console import Console
from sqlalchemy.exc import OperationalError

from app.cli.environment import read_settings, say_refusals
from app.settings import Settings

__all__ = ["migrate"]

TRY_EVERY_S = 1.0


def migrate(
    wait_s: Annotated[float, typer.Option("--wait", help="how long to wait for the database, seconds")] = 60.0,
) -> None:
    """Wait for the database, bring its schema to this version, make an admin key where there is none, and exit."""
    settings = read_settings()
    console = Console(stderr=True, highlight=False)
    with say_refusals():
        made = _migrated(settings, time.monotonic() + wait_s, console)
    if made is not None:
        console.print(f"[bold]Admin key (shown this once, keep it):[/bold] {made}", soft_wrap=True)
    console.print("The database is at this version's schema.")


def _migrated(settings: Settings, deadline: float, console: Console) -> str | None:
    from app.main import first_start

    while True:
        try:
            return first_start(settings)
        except OperationalError as error:
            if time.monotonic() > deadline:
                console.print(f"[red]the database cannot be reached: {error.orig}[/red]", soft_wrap=True)
                raise typer.Exit(1) from error
            time.sleep(TRY_EVERY_S)
