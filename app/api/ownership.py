"""One's own objects, and nobody else's: the one check between a key and a row."""

from typing import Any, TypeVar

from sqlalchemy import ColumnElement, Select, func, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.api.auth import Identity
from app.db.tables import Building, Calibration, Floor, Job, Key, Map, Survey, Track
from app.errors import NotFound

__all__ = ["find_own", "find_own_key", "own", "own_keys"]

Owned = TypeVar("Owned", Building, Calibration, Floor, Survey, Map, Job, Track)


def find_own(session: Session, identity: Identity, kind: type[Owned], row_id: str) -> Owned:
    """A row of a kind within reach. Raises NotFound: for one of another organisation, and of a building that the key is
    not limited to, just as for one there never was."""
    row = session.get(kind, row_id)
    if row is None or not _reaches(session, identity, row):
        raise NotFound(f"no {kind.__tablename__} {row_id}")
    return row


def own(identity: Identity, kind: type[Owned]) -> Select[Any]:
    """All rows of a kind within reach, for lists."""
    statement = select(kind).where(kind.organisation_id == identity.organisation_id)
    within = identity.reach.building_ids
    if within is None:
        return statement
    if kind is Building:
        return statement.where(_among(Building.id, within))
    if issubclass(kind, (Floor, Track)):
        return statement.where(_among(kind.building_id, within))
    if issubclass(kind, (Survey, Map, Job)):
        return statement.where(kind.floor_id.in_(select(Floor.id).where(_among(Floor.building_id, within))))
    raise TypeError(f"a {kind.__tablename__} is of no building")


def own_keys(session: Session, identity: Identity) -> Select[Any]:
    """All keys of the organisation that reach no further than the one that asks, for lists."""
    statement = select(Key).where(Key.organisation_id == identity.organisation_id)
    within = identity.reach.building_ids
    if within is None:
        return statement
    elements = func.json_each if session.get_bind().dialect.name == "sqlite" else func.json_array_elements_text
    building = elements(Key.building_ids).table_valued("value")
    beyond = select(building.c.value).where(building.c.value.not_in(sorted(within)))
    return statement.where(Key.building_ids.is_not(None), ~beyond.exists())


def find_own_key(session: Session, identity: Identity, key_id: str) -> Key:
    """A key of the organisation that reaches no further than the one that asks. Raises NotFound."""
    row = session.get(Key, key_id)
    if row is None or row.organisation_id != identity.organisation_id or not _reaches_key(identity, row):
        raise NotFound(f"no key {key_id}")
    return row


def _reaches_key(identity: Identity, row: Key) -> bool:
    """Whether all that a key reaches is within reach."""
    within = identity.reach.building_ids
    return within is None or (row.building_ids is not None and within.issuperset(row.building_ids))


def _reaches(session: Session, identity: Identity, row: Any) -> bool:
    if identity.reach.building_ids is None or row.organisation_id != identity.organisation_id:
        return bool(row.organisation_id == identity.organisation_id)
    building_id = _building_of(session, row)
    return building_id is not None and identity.reach.holds(row.organisation_id, building_id)


def _building_of(session: Session, row: Any) -> str | None:
    """The building a row belongs to; None for a calibration, which is of the whole organisation."""
    if isinstance(row, Building):
        return row.id
    if isinstance(row, Floor | Track):
        return row.building_id
    if isinstance(row, Survey | Map | Job):
        floor = session.get(Floor, row.floor_id)
        return None if floor is None else floor.building_id
    return None


def _among(column: InstrumentedAttribute[str], ids: frozenset[str]) -> ColumnElement[bool]:
    return column.in_(sorted(ids))
