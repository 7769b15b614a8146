"""`isodyn keys`: make, list and revoke API keys, on the database itself."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Column, Table
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.cli.environment import read_settings, say_refusals
from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Key, Organisation
from app.services.manage_keys import SCOPES, create_key, revoke_key

__all__ = ["commands"]

commands = typer.Typer(help="Make, list and revoke API keys.", no_args_is_help=True)


@contextmanager
def _database() -> Iterator[Session]:
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
) -> None:
    """Make a key and print it. It is not kept: copy it now."""
    with _database() as session:
        key = create_key(session, organisation=organisation, name=name, scopes=scope)
    print(key)


@commands.command("list")
def list_keys() -> None:
    """List keys: whose, what for, what they may do."""
    table = Table(Column("id", no_wrap=True), "organisation", "name", "scopes", "created", "revoked")
    with _database() as session:
        rows = session.execute(
            select(Key, Organisation.name).join(Organisation, Organisation.id == Key.organisation_id).order_by(Key.id)
        ).all()
        for key, organisation in rows:
            revoked = f"{key.revoked_at:%Y-%m-%d}" if key.revoked_at else ""
            table.add_row(key.id, organisation, key.name, ", ".join(key.scopes), f"{key.created_at:%Y-%m-%d}", revoked)
    Console(width=None if sys.stdout.isatty() else 200).print(table)


@commands.command()
def revoke(key_id: Annotated[str, typer.Argument(help="the id that `isodyn keys list` shows")]) -> None:
    """Make a key useless from now on."""
    with _database() as session:
        revoke_key(session, key_id)
    print(f"revoked {key_id}")
