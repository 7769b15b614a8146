"""The audit log is found by what is asked of it, not by walking through it."""

import pytest
from sqlalchemy import Engine, insert, text
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Audit, Organisation, new_id
from app.services.audit_log import select_rows


@pytest.mark.parametrize(
    ("asked", "index"),
    [
        ({"key_id": "key 7"}, "ix_audit_organisation_id_key_id_id"),
        ({"action": "key.revoke"}, "ix_audit_organisation_id_action_id"),
    ],
)
def test_each_filter_has_its_index(
    engine: Engine, sessions: sessionmaker[Session], asked: dict[str, str], index: str
) -> None:
    with sessions.begin() as session:
        owner = Organisation(name=new_id())
        session.add(owner)
        session.flush()
        session.execute(insert(Audit), [
            {"organisation_id": owner.id, "key_id": f"key {k % 100}", "actor": "a", "object_id": "o", "outcome": "done",
             "action": "key.revoke" if k % 100 == 7 else "survey.upload", "details": {}}
            for k in range(3000)
        ])  # fmt: skip
        page = select_rows(owner.id, **asked).order_by(Audit.id).limit(51)
    wanted = page.compile(engine, compile_kwargs={"literal_binds": True})
    with engine.connect() as connection:
        connection.execute(text("ANALYZE"))
        explain = "EXPLAIN QUERY PLAN" if engine.dialect.name == "sqlite" else "EXPLAIN"
        plan = "\n".join(str(row) for row in connection.execute(text(f"{explain} {wanted}")))
    assert index in plan
    assert "TEMP B-TREE" not in plan
