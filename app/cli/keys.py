"""`isodyn keys`: make, list, rotate and revoke API keys, on the database itself."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from getpass import getuser
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Column, Table
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.cli.environment import read_settings, say_refusals
from app.cli.times import read_duration, read_time
from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Key, Organisation
from app.services.audit_log import COMMAND_LINE, Actor
from app.services.manage_keys import SCOPES, create_key, find_key, revoke_key, rotate_key

__all__ = ["commands", "open_database"]

commands = typer.Typer(help="Make, list, rotate and revoke API keys.", no_args_is_help=True)
KeyId = Annotated[str, typer.Argument(help="the id that `isodyn keys list` shows")]


@contextmanager
def open_database() -> Iterator[Session]:
    """One transaction on the database that settings name, brought to today's schema."""
    settings = read_settings()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    engine = create_database_engine(settings.resolved_database_url)
    migrate(engine)
    try:
        with say_refusals(), session_factory(engine).begin() as session:
            yield session
    finally:
        engine.dispose()


@commands.command()
def create(
    name: Annotated[str, typer.Argument(help="what the key is for")],
    scope: Annotated[list[str], typer.Option(help=f"one or more of: {', '.join(SCOPES)}")],
    organisation: Annotated[str, typer.Option(help="whose things it sees; made if new")] = "default",
    building: Annotated[list[str] | None, typer.Option(help="id of a building: it sees these only")] = None,
    expires: Annotated[str | None, typer.Option(help="when it ends: 90d, 12h, or a date as in 2030-01-31")] = None,
) -> None:
    """Make a key and print it. It is not kept: copy it now."""
    ends = None if expires is None else read_time(expires)
    with open_database() as session:
        key = create_key(session, organisation=organisation, name=name, scopes=scope, building_ids=building or None,
                         expires_at=ends, by=_somebody())  # fmt: skip
    print(key)


@commands.command("list")
def list_keys() -> None:
    """List keys: whose, what for, what they may do, where and until when."""
    columns = ("organisation", "name", "scopes", "buildings", "created", "expires", "last used", "revoked")
    table = Table(Column("id", no_wrap=True), *columns)
    with open_database() as session:
        rows = session.execute(
            select(Key, Organisation.name).join(Organisation, Organisation.id == Key.organisation_id).order_by(Key.id)
        ).all()
        for key, organisation in rows:
            scopes = ", ".join(key.scopes) if key.subject is None else f"of each token of {key.issuer}"
            buildings = "all" if key.building_ids is None else ", ".join(key.building_ids)
            times = map(_day, (key.created_at, key.expires_at, key.last_used_at, key.revoked_at))
            table.add_row(key.id, organisation, key.name, scopes, buildings, *times)
    Console(width=None if sys.stdout.isatty() else 240).print(table)


@commands.command()
def rotate(
    key_id: KeyId,
    overlap: Annotated[str, typer.Option(help="how long the old key goes on to work: 0m, 90m, 24h, 7d")] = "24h",
) -> None:
    """Make a new key in place of one, and print it: same name, scopes and buildings. The old one ends after a while."""
    span = read_duration(overlap)
    with open_database() as session:
        old = find_key(session, key_id)
        made = rotate_key(session, old, _somebody(), span)
        told = (
            f"{made.row.id} takes the place of {old.id} ({old.name}), which ends at {old.expires_at:%Y-%m-%d %H:%M} UTC"
        )
    print(made.secret)
    Console(stderr=True, highlight=False).print(told, soft_wrap=True)


@commands.command()
def revoke(key_id: KeyId) -> None:
    """Make a key useless from now on."""
    with open_database() as session:
        revoke_key(session, key_id, _somebody())
    print(f"revoked {key_id}")


def _somebody() -> Actor:
    """The command line, and the system's user at it, where it has a name."""
    try:
        return Actor(f"{COMMAND_LINE.name} ({getuser()})")
    except (KeyError, OSError):
        return COMMAND_LINE


def _day(at: datetime | None) -> str:
    return "" if at is None else f"{at:%Y-%m-%d}"
