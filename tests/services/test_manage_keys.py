"""Keys: recognised by hash, remembered for a moment, useless once revoked."""

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Key
from app.services import key_ring
from app.services.key_ring import KeyRing
from app.services.manage_keys import create_key, revoke_key


def test_a_revoked_key_is_forgotten_within_seconds(
    sessions: sessionmaker[Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(key_ring, "monotonic", lambda: now)
    with sessions.begin() as session:
        secret = create_key(session, organisation="mine", name="robot", scopes=["locate"])
        key_id = session.scalars(select(Key.id).where(Key.name == "robot")).one()
    ring = KeyRing(sessions)
    assert ring.recent(secret) is None
    identity = ring.recognise(secret)
    assert identity is not None
    assert identity.may("locate")
    assert not identity.may("admin", "map:read")
    assert ring.recent(secret) == identity
    with sessions.begin() as session:
        revoke_key(session, key_id)
    assert ring.recognise(secret) is None
    now += key_ring.RECENT_S
    assert ring.recent(secret) is None
    assert ring.recognise("isd_guess") is None
