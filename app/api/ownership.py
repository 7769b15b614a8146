"""One's own objects, and nobody else's: the one check between a key and a row."""

from typing import TypeVar

from sqlalchemy.orm import Session

from app.api.auth import Identity
from app.db.tables import Building, Calibration, Floor, Job, Map, Survey, Track
from app.errors import NotFound

__all__ = ["find_own"]

Owned = TypeVar("Owned", Building, Calibration, Floor, Survey, Map, Job, Track)


def find_own(session: Session, identity: Identity, kind: type[Owned], row_id: str) -> Owned:
    """The organisation's row of a kind. Raises NotFound, for another organisation's just as for one there never was."""
    row = session.get(kind, row_id)
    if row is None or row.organisation_id != identity.organisation_id:
        raise NotFound(f"no {kind.__tablename__} {row_id}")
    return row
