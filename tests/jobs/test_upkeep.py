"""Old rows go in small batches, what has not ended stays, and new jobs run after."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import Engine, func, insert, select, text
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import FolderBlobStore
from app.db.tables import Building, Idempotency, Job, Key, Track, TrackState, TrackSteps
from app.jobs.engine import open_client
from workers.upkeep import Upkeep

if TYPE_CHECKING:
    from conftest import Crew, Site

LONG_AGO = datetime(2020, 1, 1, tzinfo=UTC)
FINISHED = 2000


def engine_rows(engine: Engine) -> dict[str, int]:
    schema = "dbos." if engine.dialect.name == "postgresql" else ""
    tables = ("workflow_status", "workflow_input", "workflow_output", "operation_outputs", "workflow_events")
    with engine.connect() as connection:
        return {name: connection.scalar(text(f"SELECT count(*) FROM {schema}{name}")) for name in tables}


def multiply(engine: Engine, name: str, copies: int) -> None:
    """Many more of one finished workflow in the engine's tables, ended long ago."""
    schema = "dbos." if engine.dialect.name == "postgresql" else ""
    with engine.begin() as connection:
        for table in ("workflow_status", "workflow_input", "workflow_output", "operation_outputs", "workflow_events"):
            found = connection.execute(text(f"SELECT * FROM {schema}{table} WHERE workflow_uuid = :name"),
                                       {"name": name}).mappings().all()  # fmt: skip
            for row in found:
                columns = [column for column in row if not (column == "id" or row[column] is None)]
                values = {column: row[column] for column in columns}
                if "completed_at" in values:
                    values["completed_at"] = int(LONG_AGO.timestamp() * 1000)
                copy = text(f"INSERT INTO {schema}{table} ({', '.join(columns)}) "
                            f"VALUES ({', '.join(f':{column}' for column in columns)})")  # fmt: skip
                connection.execute(copy, [values | {"workflow_uuid": f"{name} {n}"} for n in range(copies)])


def upkeep(engine: Engine, sessions: sessionmaker[Session], days: float = 1.0, tracks: float | None = None) -> int:
    client = open_client(engine)
    try:
        with TemporaryDirectory() as folder:
            work, deleted = Upkeep(client, sessions, FolderBlobStore(Path(folder)), days, tracks), 0
            while some := work.clean():
                deleted += some
            return deleted
    finally:
        client.destroy()


@pytest.mark.slow
def test_after_two_thousand_jobs_the_engines_tables_are_small_and_new_jobs_run(
    crew: "Crew", site: "Site", engine: Engine, sessions: sessionmaker[Session]
) -> None:
    crew.hire()
    _, done = site.upload(site.floor())
    assert site.wait(done).status == "successful"
    long_running = site.floor(sleep_s=60.0)
    _, running = site.upload(long_running)
    site.wait_running(running)
    before = engine_rows(engine)
    multiply(engine, site.job(done).workflow_id, FINISHED)
    grown = engine_rows(engine)
    assert all(grown[table] >= before[table] + FINISHED for table in grown)
    assert upkeep(engine, sessions) == FINISHED
    after = engine_rows(engine)
    assert all(after[table] <= before[table] + 10 for table in after)  # the running one writes, too
    assert upkeep(engine, sessions, days=0.0) >= 1  # the one that ended just now
    assert site.job(done).status == "successful"
    assert site.wait(site.upload(site.floor())[1]).status == "successful"
    site.cancel(running)
    assert site.wait(running).status == "dismissed"


def test_an_entry_whose_job_is_open_stays(
    site: "Site", engine: Engine, sessions: sessionmaker[Session], crew: "Crew"
) -> None:
    crew.hire()
    _, job_id = site.upload(site.floor())
    site.wait(job_id)
    upkeep(engine, sessions)
    with sessions.begin() as session:
        session.get_one(Job, job_id).status = "running"
    upkeep(engine, sessions, days=0.0)
    client = open_client(engine)
    assert client.list_workflows(workflow_ids=[site.job(job_id).workflow_id])
    client.destroy()
    with sessions.begin() as session:
        session.get_one(Job, job_id).status = "successful"


@pytest.mark.parametrize("days", [None, 30.0])
def test_tracks_that_ended_long_ago_go_where_that_is_asked_for(
    site: "Site", engine: Engine, sessions: sessionmaker[Session], days: float | None
) -> None:
    floor = site.floor()
    ended = {"ended a year ago": 365, "ended yesterday": 1, "active": None}
    with sessions.begin() as session:
        key = Key(organisation_id=floor.organisation_id, name="k", sha256=floor.id.ljust(64, "0"), scopes=[])
        session.add(key)
        session.flush()
        building = session.scalars(select(Building).where(Building.id == floor.building_id)).one()
        for name, days_ago in ended.items():
            track = Track(
                organisation_id=floor.organisation_id, key_id=key.id, building_id=building.id, name=name,
                frame="level", seed=1, spec={}, status="active" if days_ago is None else "ended",
                ended_at=None if days_ago is None else datetime.now(UTC) - timedelta(days=days_ago),
            )  # fmt: skip
            session.add(track)
            session.flush()
            session.add_all(
                TrackSteps(track_id=track.id, sequence=n, next_step=n, data=b"", sha256="0" * 64) for n in range(3)
            )
            session.add(TrackState(track_id=track.id, batches=0, written_by="w", data=b""))
    upkeep(engine, sessions, tracks=days)
    with sessions() as session:
        left = session.scalars(select(Track).where(Track.organisation_id == floor.organisation_id)).all()
        assert {track.name for track in left} == set(ended) - ({"ended a year ago"} if days else set())
        ids = [track.id for track in left]
        assert session.scalar(select(func.count(TrackSteps.sequence)).where(TrackSteps.track_id.in_(ids))) == 3 * len(
            ids
        )


def test_old_idempotency_keys_go(site: "Site", engine: Engine, sessions: sessionmaker[Session]) -> None:
    floor = site.floor()
    with sessions.begin() as session:
        for key, at in (("old", LONG_AGO), ("new", datetime.now(UTC))):
            row = {
                "organisation_id": floor.organisation_id,
                "key": key,
                "fingerprint": "",
                "status_code": 201,
                "body": {},
            }
            session.execute(insert(Idempotency).values(**row, created_at=at))
    upkeep(engine, sessions)
    with sessions() as session:
        mine = select(Idempotency.key).where(Idempotency.organisation_id == floor.organisation_id)
        assert session.scalars(mine).all() == ["new"]
