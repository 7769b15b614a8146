"""Who asks: API keys, and tokens of an identity provider, recognised and remembered for a moment."""

import logging
import secrets
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from time import monotonic

from sqlalchemy import bindparam, or_, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Key, Organisation, utc_now
from app.services.audit_log import Actor, record
from app.services.reach import Reach

__all__ = ["RECENT_S", "Identity", "KeyRing", "ReadToken", "TokenClaims", "digest", "recognise_key"]

_log = logging.getLogger(__name__)

RECENT_S = 2.0
"""A revoked key may still be taken for this long, in each process."""
MOST_RECENT = 10_000


@dataclass(frozen=True, slots=True)
class Identity:
    """Who asks: how far that reaches, and what may be done there. `name`: the key's, or the subject of a token."""

    reach: Reach
    scopes: frozenset[str]
    key_id: str
    name: str
    organisation: str

    @property
    def organisation_id(self) -> str:
        return self.reach.organisation_id

    @property
    def is_limited(self) -> bool:
        """Whether it reaches some buildings only."""
        return self.reach.building_ids is not None

    def may(self, *any_of: str) -> bool:
        """Whether the key has one of these scopes; `admin` has them all."""
        return "admin" in self.scopes or not self.scopes.isdisjoint(any_of)


@dataclass(frozen=True, slots=True)
class TokenClaims:
    """What a token says that was found to be good. `building_ids` None: all of the organisation."""

    issuer: str
    subject: str
    organisation: str
    scopes: frozenset[str]
    building_ids: frozenset[str] | None
    expires_at: datetime


Found = tuple[Identity, datetime | None]
"""Who it is, and when that ends."""

ReadToken = Callable[[str], TokenClaims | None]
"""What a token says, None when it is not good. May raise Unavailable, and block."""


class KeyRing:
    """Recognises keys and remembers those of the last seconds: a busy client costs one look-up in `RECENT_S`.

    `read_token` reads bearer tokens (JSON Web Tokens) of an identity provider, where there is one.
    """

    def __init__(self, sessions: sessionmaker[Session], read_token: ReadToken | None = None) -> None:
        self._sessions, self._read_token = sessions, read_token
        self._recent: dict[str, tuple[float, Identity]] = {}
        self._used: dict[str, datetime] = {}

    def recent(self, secret: str) -> Identity | None:
        """Whose key this is if it was recognised a moment ago; asks nobody."""
        known = self._recent.get(digest(secret))
        return known[1] if known is not None and monotonic() < known[0] else None

    def recognise(self, secret: str) -> Identity | None:
        """Whose key this is, by the database. Raises Unavailable when a token's issuer cannot be asked."""
        if self._read_token is not None and _is_token(secret):
            claims = self._read_token(secret)
            found = None if claims is None else _recognise_subject(self._sessions, claims)
        else:
            with self._sessions() as session:
                found = recognise_key(session, secret)
        if found is None:
            return None
        identity, expires_at = found
        now = utc_now()
        self._used[identity.key_id] = now
        if len(self._recent) >= MOST_RECENT:
            self._recent.clear()
        lasts_s = RECENT_S if expires_at is None else min(RECENT_S, (expires_at - now).total_seconds())
        self._recent[digest(secret)] = (monotonic() + lasts_s, identity)
        return identity

    def note_uses(self) -> None:
        """Write down when keys were last used. Called now and then, so that no request waits for it.

        In order of their ids: processes that write of the same keys wait for each other, and never in a circle.
        """
        used, self._used = self._used, {}
        if used:
            with self._sessions.begin() as session:
                session.connection().execute(
                    _LAST_USED, [{"of": key_id, "now": at} for key_id, at in sorted(used.items())]
                )


def recognise_key(session: Session, secret: str) -> Found | None:
    """Whose key this is and when it ends, or None. Found by its SHA-256: keys are 256 random bits, so a fast hash is
    enough, and how long the look-up takes tells nothing of any key."""
    wanted = _OF_KEY.where(Key.sha256 == digest(secret), Key.subject.is_(None))
    row = session.execute(wanted, {"now": utc_now()}).one_or_none()
    if row is None:
        return None
    key, organisation = row
    within = None if key.building_ids is None else frozenset(key.building_ids)
    reach = Reach(key.organisation_id, within)
    return Identity(reach, frozenset(key.scopes), key.id, key.name, organisation), key.expires_at


def digest(secret: str) -> str:
    """What is kept of a key."""
    return sha256(secret.encode()).hexdigest()


def _is_token(secret: str) -> bool:
    """Whether it is a JSON Web Token by its looks: three parts, the first a JSON object in base64."""
    return secret.startswith("eyJ") and secret.count(".") == 2


def _recognise_subject(sessions: sessionmaker[Session], claims: TokenClaims) -> Found | None:
    """A token's subject, who has a row among the keys from the first sight on.

    None for an organisation there is not (a token never makes one), and for a subject that was revoked.
    """
    with sessions() as session:
        named = select(Organisation.id).where(Organisation.name == claims.organisation)
        owner_id = session.scalars(named).one_or_none()
        if owner_id is None:
            _log.warning("a token of %s names organisation %r, which is not here", claims.issuer, claims.organisation)
            return None
        which = (Key.organisation_id == owner_id, Key.issuer == claims.issuer, Key.subject == claims.subject)
        known = select(Key.id, Key.revoked_at, Key.expires_at).where(*which)
        row = session.execute(known).one_or_none()
    if row is None:
        with suppress(IntegrityError), sessions.begin() as session:  # another process may see it at the same moment
            _first_sight(session, owner_id, claims)
        with sessions() as session:
            row = session.execute(known).one()
    if row.revoked_at is not None or (row.expires_at is not None and row.expires_at <= utc_now()):
        return None
    reach = Reach(owner_id, claims.building_ids)
    return Identity(reach, claims.scopes, row.id, claims.subject, claims.organisation), claims.expires_at


def _first_sight(session: Session, owner_id: str, claims: TokenClaims) -> None:
    row = Key(
        organisation_id=owner_id, name=claims.subject[:200], sha256=digest(secrets.token_urlsafe(32)), scopes=[],
        issuer=claims.issuer, subject=claims.subject,
    )  # fmt: skip
    session.add(row)
    session.flush()
    record(session, Actor(claims.subject, row.id), "create", row, issuer=claims.issuer)


_OF_KEY = (
    select(Key, Organisation.name)
    .join(Organisation, Organisation.id == Key.organisation_id)
    .where(Key.revoked_at.is_(None), or_(Key.expires_at.is_(None), Key.expires_at > bindparam("now")))
)
_LAST_USED = (
    update(Key.__table__)  # type: ignore[arg-type]
    .where(Key.__table__.c.id == bindparam("of"))
    .where(or_(Key.__table__.c.last_used_at.is_(None), Key.__table__.c.last_used_at < bindparam("now")))
    .values(last_used_at=bindparam("now"))
)
