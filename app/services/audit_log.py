"""Who did what: a row a change, in the transaction of that change, so that neither is there without the other.

Rows are only ever added, and removed when they are old. Whoever can write to the database can change them: that is not
defended against here (docs/audit.md).
"""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Protocol

from sqlalchemy import Select, delete, select
from sqlalchemy.orm import Session

from app.db.tables import Audit, utc_now

__all__ = ["ACCEPTED", "COMMAND_LINE", "DONE", "Actor", "prune", "record", "select_rows"]

DONE, ACCEPTED = "done", "accepted"


class Recorded(Protocol):
    """A row of an organisation."""

    __tablename__: str

    @property
    def id(self) -> Any: ...

    @property
    def organisation_id(self) -> Any: ...


@dataclass(frozen=True, slots=True)
class Actor:
    """Who acts, and from where: the key's name, or the subject an identity provider vouches for."""

    name: str
    key_id: str | None = None
    address: str | None = None
    request_id: str | None = None


COMMAND_LINE = Actor("command line")


def record(session: Session, by: Actor, verb: str, row: Recorded, outcome: str = DONE, **details: object) -> None:
    """Add to the log what becomes of a row (which has its id) in this transaction.

    `details` are ids, names of fields and short words: never a secret, never what a body held.
    """
    session.add(
        Audit(
            organisation_id=row.organisation_id,
            key_id=by.key_id,
            actor=by.name[:300],
            action=f"{row.__tablename__}.{verb}",
            object_id=row.id,
            outcome=outcome,
            address=by.address and by.address[:60],
            request_id=by.request_id and by.request_id[:128],
            details={name: value for name, value in details.items() if value is not None},
        )
    )


def select_rows(
    organisation_id: str | None = None, *, object_id: str | None = None, key_id: str | None = None,
    action: str | None = None, since: datetime | None = None,
) -> Select[Any]:  # fmt: skip
    """The rows that were asked for; of every organisation, and of everything, where nothing is said."""
    told = {Audit.organisation_id: organisation_id, Audit.object_id: object_id, Audit.key_id: key_id,
            Audit.action: action}  # fmt: skip
    statement = select(Audit).where(*[column == value for column, value in told.items() if value is not None])
    return statement if since is None else statement.where(Audit.at >= since)


def prune(session: Session, days: int) -> int:
    """Remove what is older; how many rows."""
    done: Any = session.execute(delete(Audit).where(Audit.at < utc_now() - timedelta(days=days)))
    return int(done.rowcount)
