"""API keys: made, shown once, kept as a hash, recognised, revoked."""

import secrets
from collections.abc import Collection
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from time import monotonic

from sqlalchemy import select
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Key, Organisation
from app.errors import InvalidInput, NotFound

__all__ = ["SCOPES", "Identity", "KeyRing", "create_key", "ensure_admin_key", "recognise_key", "revoke_key"]

SCOPES = ("admin", "survey:write", "map:read", "map:write", "locate")
KEY_PREFIX = "isd_"
RECENT_S = 2.0  # a revoked key may still be taken for this long
MOST_RECENT = 10_000


@dataclass(frozen=True, slots=True)
class Identity:
    """Who asks: the organisation whose things are visible, and what may be done with them."""

    organisation_id: str
    scopes: frozenset[str]
    key_id: str

    def may(self, *any_of: str) -> bool:
        """Whether the key has one of these scopes; `admin` has them all."""
        return "admin" in self.scopes or not self.scopes.isdisjoint(any_of)


def create_key(
    session: Session, *, organisation: str, name: str, scopes: Collection[str], secret: str | None = None
) -> str:
    """A new key of the organisation (made if new). Returns the key itself, which is not kept."""
    unknown = sorted(set(scopes) - set(SCOPES))
    if unknown or not scopes:
        raise InvalidInput(f"unknown scope {', '.join(unknown) or '(none given)'}; choose from {', '.join(SCOPES)}")
    owner = session.scalars(select(Organisation).where(Organisation.name == organisation)).one_or_none()
    if owner is None:
        owner = Organisation(name=organisation)
        session.add(owner)
        session.flush()
    secret = secret or KEY_PREFIX + secrets.token_urlsafe(32)
    session.add(Key(organisation_id=owner.id, name=name, sha256=_digest(secret), scopes=sorted(scopes)))
    return secret


def ensure_admin_key(session: Session, wanted: str | None) -> str | None:
    """At start: make the wanted admin key if it is not there, or one of our own if there is no key at all.

    Returns a key only when one was made here that nobody has seen yet. Raises InvalidInput for a revoked one.
    """
    if wanted:
        known = session.execute(select(Key.revoked_at).where(Key.sha256 == _digest(wanted))).one_or_none()
        if known is not None and known.revoked_at is not None:
            raise InvalidInput("the key in ISODYN_ADMIN_KEY was revoked; set another, or leave it unset")
        if known is None:
            create_key(session, organisation="default", name="admin (settings)", scopes=["admin"], secret=wanted)
        return None
    if session.scalars(select(Key.id).limit(1)).first() is not None:
        return None
    return create_key(session, organisation="default", name="admin (first start)", scopes=["admin"])


def recognise_key(session: Session, secret: str) -> Identity | None:
    """Whose key this is, or None. Found by its SHA-256: keys are 256 random bits, so a fast hash is enough."""
    row = session.execute(
        select(Key.organisation_id, Key.scopes, Key.id).where(Key.sha256 == _digest(secret), Key.revoked_at.is_(None))
    ).one_or_none()
    return None if row is None else Identity(row.organisation_id, frozenset(row.scopes), row.id)


class KeyRing:
    """Recognises keys and remembers those of the last seconds: a busy client costs one look-up in `RECENT_S`."""

    def __init__(self, sessions: sessionmaker[Session]) -> None:
        self._sessions = sessions
        self._recent: dict[str, tuple[float, Identity]] = {}

    def recent(self, secret: str) -> Identity | None:
        """Whose key this is if it was recognised a moment ago; asks nobody."""
        until, identity = self._recent.get(_digest(secret), (0.0, None))
        return identity if monotonic() < until else None

    def recognise(self, secret: str) -> Identity | None:
        """Whose key this is, by the database."""
        with self._sessions() as session:
            identity = recognise_key(session, secret)
        if identity is not None:
            if len(self._recent) >= MOST_RECENT:
                self._recent.clear()
            self._recent[_digest(secret)] = (monotonic() + RECENT_S, identity)
        return identity


def revoke_key(session: Session, key_id: str) -> None:
    """Make a key useless from now on. Raises NotFound."""
    key = session.get(Key, key_id)
    if key is None:
        raise NotFound(f"no key {key_id}; `isodyn keys list` shows them")
    key.revoked_at = key.revoked_at or datetime.now(UTC)


def _digest(secret: str) -> str:
    return sha256(secret.encode()).hexdigest()
