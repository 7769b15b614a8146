"""`isodyn audit`: who did what, from the database itself."""

import json
from typing import Annotated

import typer
from sqlalchemy import select

from app.cli.keys import open_database
from app.cli.times import read_time
from app.db.tables import Audit, Organisation
from app.services.audit_log import select_rows

__all__ = ["audit"]

COLUMNS = ("actor", "key_id", "action", "object_id", "outcome", "address", "request_id", "details")


def audit(
    organisation: Annotated[str | None, typer.Option(help="of this organisation only, by name")] = None,
    object: Annotated[str | None, typer.Option(help="of the object with this id only")] = None,
    actor: Annotated[str | None, typer.Option(help="by the key with this id only")] = None,
    action: Annotated[str | None, typer.Option(help="of one kind only, as in survey.upload")] = None,
    since: Annotated[str | None, typer.Option(help="of the last 24h or 7d, or since a date as in 2030-01-31")] = None,
) -> None:
    """Write the audit log, who did what, as JSON lines, oldest first: docs/audit.md."""
    begins = None if since is None else read_time(since, ago=True)
    with open_database() as session:
        names = {row.id: row.name for row in session.scalars(select(Organisation))}
        asked = select_rows(object_id=object, key_id=actor, action=action, since=begins)
        if organisation is not None:
            asked = asked.join(Organisation).where(Organisation.name == organisation)
        for row in session.scalars(asked.order_by(Audit.id).execution_options(yield_per=500)):
            told = {"id": row.id, "at": row.at.isoformat(), "organisation": names[row.organisation_id]}
            print(json.dumps(told | {name: getattr(row, name) for name in COLUMNS}))
