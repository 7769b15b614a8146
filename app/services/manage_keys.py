"""API keys: made, shown once, kept as a hash, rotated, revoked. `app.services.key_ring` recognises them."""

import secrets
from collections.abc import Collection
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.db.tables import Building, Key, Organisation, utc_now
from app.errors import Conflict, InvalidInput, NotFound
from app.services.audit_log import COMMAND_LINE, Actor, record
from app.services.key_ring import digest

__all__ = [
    "OPERATOR",
    "OVERLAP",
    "SCOPES",
    "MadeKey",
    "create_key",
    "ensure_admin_key",
    "find_key",
    "make_key",
    "revoke_key",
    "rotate_key",
]

SCOPES = ("admin", "survey:write", "map:read", "map:write", "locate", "track:read")
OPERATOR = "default"
"""The organisation of whoever runs the installation: that of `ISODYN_ADMIN_KEY`."""
OVERLAP = timedelta(hours=24)
"""How long a key that was rotated goes on to work, unless told otherwise."""
KEY_PREFIX = "isd_"


@dataclass(frozen=True, slots=True)
class MadeKey:
    """A new key, and the key itself, which is not kept."""

    row: Key
    secret: str


def make_key(
    session: Session,
    owner: Organisation,
    by: Actor,
    *,
    name: str,
    scopes: Collection[str],
    building_ids: Collection[str] | None = None,
    expires_at: datetime | None = None,
    secret: str | None = None,
) -> MadeKey:
    """A new key of an organisation, limited to `building_ids` where there are any.

    Raises InvalidInput for an unknown scope, no building at all, or an end that has passed; NotFound for a building
    that is not the organisation's.
    """
    unknown = sorted(set(scopes) - set(SCOPES))
    if unknown or not scopes:
        raise InvalidInput(f"unknown scope {', '.join(unknown) or '(none given)'}; choose from {', '.join(SCOPES)}")
    if expires_at is not None and expires_at <= utc_now():
        raise InvalidInput(f"{expires_at:%Y-%m-%d %H:%M} UTC has passed: the key would never work")
    if building_ids is not None:
        _check_buildings(session, owner.id, building_ids)
    secret = secret or KEY_PREFIX + secrets.token_urlsafe(32)
    row = Key(
        organisation_id=owner.id,
        name=name,
        sha256=digest(secret),
        scopes=sorted(scopes),
        building_ids=None if building_ids is None else sorted(building_ids),
        expires_at=expires_at,
    )
    session.add(row)
    session.flush()
    record(session, by, "create", row, name=name, scopes=row.scopes, building_ids=row.building_ids,
           expires_at=_told(expires_at))  # fmt: skip
    return MadeKey(row, secret)


def create_key(
    session: Session, *, organisation: str, name: str, scopes: Collection[str], secret: str | None = None,
    building_ids: Collection[str] | None = None, expires_at: datetime | None = None, by: Actor = COMMAND_LINE,
) -> str:  # fmt: skip
    """The same for an organisation by name, which is made if new. Returns the key itself, which is not kept."""
    owner = session.scalars(select(Organisation).where(Organisation.name == organisation)).one_or_none()
    if owner is None:
        owner = Organisation(name=organisation)
        session.add(owner)
        session.flush()
    made = make_key(session, owner, by, name=name, scopes=scopes, building_ids=building_ids, expires_at=expires_at,
                    secret=secret)  # fmt: skip
    return made.secret


def ensure_admin_key(session: Session, wanted: str | None) -> str | None:
    """At start: make the wanted admin key if it is not there, or one of our own if there is no key at all.

    Returns a key only when one was made here that nobody has seen yet. Raises InvalidInput for one that has ended.
    """
    if wanted:
        known = session.scalars(select(Key).where(Key.sha256 == digest(wanted))).one_or_none()
        if known is not None and has_ended(known):
            raise InvalidInput("the key in ISODYN_ADMIN_KEY was revoked or has expired; set another, or leave it unset")
        if known is None:
            create_key(session, organisation=OPERATOR, name="admin (settings)", scopes=["admin"], secret=wanted)
        return None
    if session.scalars(select(Key.id).limit(1)).first() is not None:
        return None
    return create_key(session, organisation=OPERATOR, name="admin (first start)", scopes=["admin"])


def find_key(session: Session, key_id: str) -> Key:
    """Any organisation's. Raises NotFound."""
    row = session.get(Key, key_id)
    if row is None:
        raise NotFound(f"no key {key_id}; `isodyn keys list` shows them")
    return row


def rotate_key(session: Session, row: Key, by: Actor, overlap: timedelta = OVERLAP) -> MadeKey:
    """A new key with the name, scopes, buildings and span of life of this one, which ends after the overlap.

    Raises Conflict for one that has ended, or that has no secret.
    """
    if row.subject is not None:
        raise Conflict(f"key {row.id} stands for a subject of {row.issuer}: there is no secret to rotate")
    if has_ended(row):
        raise Conflict(f"key {row.id} was revoked or has expired; make a new one")
    now = utc_now()
    owner = session.get_one(Organisation, row.organisation_id)
    lives = None if row.expires_at is None else row.expires_at - row.created_at
    made = make_key(
        session, owner, by, name=row.name, scopes=row.scopes, building_ids=row.building_ids,
        expires_at=None if lives is None else now + lives,
    )  # fmt: skip
    ends_at = now + overlap
    row.expires_at = ends_at if row.expires_at is None else min(row.expires_at, ends_at)
    record(session, by, "rotate", row, new_key_id=made.row.id, expires_at=_told(row.expires_at))
    return made


def revoke_key(session: Session, key_id: str, by: Actor = COMMAND_LINE) -> None:
    """Make a key useless from now on; once more changes nothing. Raises NotFound."""
    row = find_key(session, key_id)
    if row.revoked_at is None:
        row.revoked_at = utc_now()
        record(session, by, "revoke", row)


def has_ended(row: Key) -> bool:
    """Whether it was revoked or has expired."""
    return row.revoked_at is not None or (row.expires_at is not None and row.expires_at <= utc_now())


def _check_buildings(session: Session, organisation_id: str, building_ids: Collection[str]) -> None:
    if not building_ids:
        raise InvalidInput("a key that is limited to buildings needs one at least; leave them out for all")
    mine = select(Building.id).where(Building.organisation_id == organisation_id, Building.id.in_(building_ids))
    for missing in sorted(set(building_ids) - set(session.scalars(mine))):
        raise NotFound(f"no building {missing}")


def _told(at: datetime | None) -> str | None:
    return None if at is None else at.isoformat(timespec="seconds")
