"""Every column that may name a blob is known: to be followed, or to name none."""

from collections.abc import Callable
from typing import Any

from sqlalchemy import JSON, Engine, String
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import BlobStore
from app.db.tables import Base, Floor, Map
from app.jobs.queue import JobQueue
from app.services.manage_keys import ensure_admin_key
from app.services.references import CACHES, IN_HAND, IN_JSON, NAMING, carried_by_jobs, references

HASHES_OF_NO_BLOB = {"key.sha256", "track_steps.sha256", "idempotency.fingerprint", "job.request_id"}

JSON_WITHOUT_BLOBS = {
    "key.scopes", "key.building_ids", "audit.details",
    "building.anchor", "floor.outline", "calibration.model", "calibration.fit", "calibration.reference",
    "survey.report", "survey.excluded_s", "map.spec", "map.survey_ids", "map.bounds_m", "map.hyperparameters",
    "map.score", "track.waiting", "track.gaps", "track_steps.settled",
    "job.plan",          # every hash in it is held while the job is in hand (`carried_by_jobs`)
    "job.result",        # the hash of a grid that its map names too; maps are never removed
    "idempotency.body",  # an answer as it was once given
}  # fmt: skip


def columns(kind: type) -> set[str]:
    return {
        f"{table.name}.{column.name}"
        for table in Base.metadata.sorted_tables
        for column in table.columns
        if isinstance(column.type, kind)
    }


def named(of: Any) -> set[str]:
    return {f"{column.class_.__tablename__}.{column.key}" for column in of}


def test_a_new_column_with_a_hash_must_be_said_to_name_a_blob_or_not() -> None:
    hashes = {
        f"{table.name}.{column.name}"
        for table in Base.metadata.sorted_tables
        for column in table.columns
        if (isinstance(column.type, String) and column.type.length == 64) or "sha256" in column.name
    }
    assert hashes == named(NAMING) | named(CACHES) | named(IN_HAND) | HASHES_OF_NO_BLOB


def test_a_new_json_column_must_be_said_to_name_blobs_or_not() -> None:
    assert columns(JSON) == named(IN_JSON) | JSON_WITHOUT_BLOBS


def test_what_a_database_names(
    engine: Engine, sessions: sessionmaker[Session], blob_store: BlobStore,
    put_hall: Callable[[Session, BlobStore], tuple[str, str]],
) -> None:  # fmt: skip
    with sessions.begin() as session:
        ensure_admin_key(session, "isd_x")
        session.flush()
        _, floor_id = put_hall(session, blob_store)
        session.get_one(Floor, floor_id).plan = {"sha256": "f" * 64}
        session.query(Map).one().state_sha256 = "e" * 64
    with sessions() as session:
        found = references(session)
        grid = session.query(Map).one().grid_sha256
    assert found.needed["floor.plan"] == {"f" * 64}
    assert found.all_needed == {grid, "f" * 64}
    assert found.all == {grid, "f" * 64, "e" * 64}
    assert found.named_by("e" * 64) == ["map.state_sha256"]
    queue = JobQueue(engine)
    with sessions.begin() as session:
        assert carried_by_jobs(session, queue) == frozenset()
    queue.close()
