"""Keys: recognised by hash, remembered for a moment, useless once revoked or expired."""

import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest
from sqlalchemy import event, select, update
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Audit, Key, utc_now
from app.errors import Conflict, InvalidInput, NotFound
from app.services import key_ring
from app.services.audit_log import COMMAND_LINE
from app.services.key_ring import KeyRing
from app.services.manage_keys import create_key, ensure_admin_key, revoke_key, rotate_key


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


def test_uses_are_written_in_one_order_by_all_processes(sessions: sessionmaker[Session]) -> None:
    with sessions.begin() as session:
        secrets = [create_key(session, organisation="mine", name=f"{k}", scopes=["locate"]) for k in range(3)]
    orders: list[list[str]] = []

    def note(_c: object, _u: object, statement: str, rows: list[dict[str, str]], *_: object) -> None:
        orders.append([next(str(v) for v in (row.values() if isinstance(row, dict) else row) if str(v) in ids)
                       for row in rows])  # fmt: skip

    ids: set[str] = set()
    engine = sessions.kw["bind"]
    for told in (secrets, secrets[::-1]):
        ring = KeyRing(sessions)
        found = [ring.recognise(secret) for secret in told]
        ids.update(each.key_id for each in found if each is not None)
        event.listen(engine, "before_cursor_execute", note)
        ring.note_uses()
        event.remove(engine, "before_cursor_execute", note)
    assert orders == [sorted(ids)] * 2


def test_each_process_forgets_by_itself_within_its_two_seconds(
    sessions: sessionmaker[Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two rings are two processes: neither is told of what the other's revoked, and both know it in time."""
    now = 100.0
    monkeypatch.setattr(key_ring, "monotonic", lambda: now)
    with sessions.begin() as session:
        secret = create_key(session, organisation="mine", name="two", scopes=["locate"])
        key_id = session.scalars(select(Key.id).where(Key.name == "two")).one()
    rings = KeyRing(sessions), KeyRing(sessions)
    for ring in rings:
        assert ring.recognise(secret)
    with sessions.begin() as session:
        revoke_key(session, key_id)
    now += key_ring.RECENT_S - 0.01
    assert all(ring.recent(secret) for ring in rings), "this is the bound that docs/keys.md states"
    now += 0.01
    assert not any(ring.recent(secret) or ring.recognise(secret) for ring in rings)


def test_two_processes_write_down_the_same_keys_at_once(sessions: sessionmaker[Session]) -> None:
    with sessions.begin() as session:
        secrets = [create_key(session, organisation="mine", name=f"busy {n}", scopes=["locate"]) for n in (1, 2)]
        first, second = session.scalars(select(Key.id).where(Key.name.startswith("busy")).order_by(Key.id)).all()
    ring = KeyRing(sessions)
    assert all(ring.recognise(secret) for secret in reversed(secrets))
    with ThreadPoolExecutor(1) as pool:
        with sessions.begin() as other:
            other.execute(update(Key).where(Key.id == first).values(last_used_at=None))
            noting = pool.submit(ring.note_uses)
            time.sleep(0.5)  # it has its first lock, or waits for it
            other.execute(update(Key).where(Key.id == second).values(last_used_at=None))
        noting.result()
    with sessions() as session:
        assert all(session.get_one(Key, key_id).last_used_at for key_id in (first, second))


def test_an_expired_key_is_not_remembered_past_its_end(
    sessions: sessionmaker[Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    now, at = 100.0, utc_now()
    monkeypatch.setattr(key_ring, "monotonic", lambda: now)
    monkeypatch.setattr(key_ring, "utc_now", lambda: at)
    ends = at + timedelta(seconds=0.5)
    with sessions.begin() as session:
        secret = create_key(session, organisation="mine", name="short", scopes=["locate"], expires_at=ends)
    ring = KeyRing(sessions)
    assert ring.recognise(secret)
    now += 0.49
    assert ring.recent(secret)
    now, at = now + 0.02, ends
    assert ring.recent(secret) is None
    assert ring.recognise(secret) is None


def test_a_key_is_limited_to_buildings_there_are(sessions: sessionmaker[Session]) -> None:
    for wrong, error in ((["nowhere"], NotFound), ([], InvalidInput)):
        with pytest.raises(error), sessions.begin() as session:
            create_key(session, organisation="mine", name="x", scopes=["locate"], building_ids=wrong)


def test_a_subject_of_a_provider_has_no_secret(sessions: sessionmaker[Session]) -> None:
    """Not even the hash that its row has opens anything; and there is nothing to rotate."""
    with sessions.begin() as session:
        secret = create_key(session, organisation="mine", name="plain", scopes=["admin"])
        row = session.scalars(select(Key).where(Key.name == "plain")).one()
        row.issuer, row.subject = "https://id.example", "anna"
        with pytest.raises(Conflict, match="no secret"):
            rotate_key(session, row, COMMAND_LINE)
    assert KeyRing(sessions).recognise(secret) is None


def test_an_admin_key_of_the_settings_that_has_ended_stops_the_start(sessions: sessionmaker[Session]) -> None:
    with sessions.begin() as session:
        ensure_admin_key(session, "isd_of-the-settings")
    with sessions.begin() as session:
        ensure_admin_key(session, "isd_of-the-settings")
        row = session.scalars(select(Key).where(Key.name == "admin (settings)")).one()
        row.expires_at = utc_now()
        assert session.scalars(select(Audit.action).where(Audit.object_id == row.id)).all() == ["key.create"]
    with pytest.raises(InvalidInput, match="has expired"), sessions.begin() as session:
        ensure_admin_key(session, "isd_of-the-settings")
