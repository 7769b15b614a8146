"""Installations to back up: a database with a row of everything, and its blobs."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from sqlalchemy import Engine, create_engine, make_url, text
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import FolderBlobStore
from app.db.engine import create_database_engine, migrate, session_factory
from app.db.portable_rows import columns_of, row_as_line, rows_of
from app.db.snapshot import snapshot
from app.db.tables import (
    Audit,
    Base,
    Building,
    Calibration,
    Floor,
    Idempotency,
    Key,
    Map,
    Organisation,
    Survey,
    Track,
    TrackState,
    TrackSteps,
    Worker,
)
from app.jobs.queue import JobQueue
from app.services.make_backup import LEFT_OUT, Backup, make_backup
from app.services.restore_backup import Restored, restore_backup

ODD = 'Gebäude "Ω"\n\u2028 \\ 名'


@dataclass(frozen=True)
class Site:
    """An installation without any process."""

    url: str
    engine: Engine
    sessions: sessionmaker[Session]
    blobs: FolderBlobStore
    queue: JobQueue

    def rows(self) -> dict[str, list[bytes]]:
        """Every row that a backup has, by table, as a line, sorted."""
        with snapshot(self.engine) as connection:
            return {
                table.name: sorted(row_as_line(columns_of(table), row) for row in rows_of(connection, table))
                for table in Base.metadata.sorted_tables
                if table.name not in LEFT_OUT
            }

    def blob_names(self) -> list[str]:
        return [blob.sha256 for blob in self.blobs.stored()]

    def back_up(self, path: Path) -> Backup:
        return make_backup(self.engine, self.blobs, path, silent)


def silent(_what: str, done: int, total: int) -> None:
    assert 0 <= done <= total


@pytest.fixture
def new_url(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[[str], str]]:
    """Addresses of databases where nothing is yet, of this test's own."""
    made: list[tuple[Engine, str]] = []

    def make(kind: str) -> str:
        if kind == "sqlite":
            return f"sqlite:///{tmp_path / uuid4().hex / 'isodyn.db'}"
        base = make_url(request.getfixturevalue("postgres_url"))
        name = f"{base.database}_{uuid4().hex[:8]}"
        server = create_engine(base, isolation_level="AUTOCOMMIT")
        with server.connect() as connection:
            connection.execute(text(f"CREATE DATABASE {name}"))
        made.append((server, name))
        return base.set(database=name).render_as_string(hide_password=False)

    yield make
    for server, name in made:
        with server.connect() as connection:
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
        server.dispose()


@pytest.fixture
def open_site(tmp_path: Path) -> Iterator[Callable[..., Site]]:
    """An installation on a database that is migrated already (else `migrated=False` to do so here)."""
    opened: list[Site] = []

    def make(url: str, folder: Path | None = None, *, migrated: bool = True) -> Site:
        if not migrated:
            migrate(url)
        engine = create_database_engine(url)
        blobs = FolderBlobStore(folder or tmp_path / uuid4().hex)
        opened.append(Site(url, engine, session_factory(engine), blobs, JobQueue(engine)))
        return opened[-1]

    yield make
    for site in opened:
        site.queue.close()
        site.engine.dispose()


@pytest.fixture
def site(new_url: Callable[[str], str], open_site: Callable[..., Site]) -> Site:
    """One on SQLite, with a row of everything."""
    made = open_site(new_url("sqlite"), migrated=False)
    fill(made)
    return made


@pytest.fixture
def restore(new_url: Callable[[str], str], open_site: Callable[..., Site], tmp_path: Path) -> Callable[..., Any]:
    """Restore an archive into a new installation of a kind."""

    def make(archive: Path, kind: str = "sqlite") -> tuple[Site, Restored]:
        url, folder = new_url(kind), tmp_path / uuid4().hex
        done = restore_backup(url, FolderBlobStore(folder), archive, silent)
        return open_site(url, folder), done

    return make


def fill(site: Site) -> None:
    """A row of every table, JSON null beside NULL, and a waiting rebuild beside a running build."""
    put = site.blobs.put
    with site.sessions.begin() as session:
        owner = Organisation(name=ODD)
        session.add(owner)
        session.flush()
        key = Key(organisation_id=owner.id, name="k", sha256="a" * 64, scopes=["admin"])
        anchor = {"latitude_deg": 48.140300000000001, "height_m": 1e300, "name": ODD}
        building = Building(organisation_id=owner.id, name=ODD, anchor=anchor)
        session.add_all([key, building])
        session.flush()
        session.add(Audit(organisation_id=owner.id, actor=ODD, action="building.create", object_id=building.id,
                          outcome="done", details={"name": ODD}))  # fmt: skip
        plan = {"sha256": put(b"a picture"), "x_m": 0.1}
        floors = [
            Floor(organisation_id=owner.id, building_id=building.id, name=f"{ordinal}", ordinal=ordinal,
                  elevation_m=0.1 * ordinal, plan=plan if ordinal else None)
            for ordinal in (-1, 0, 1)
        ]  # fmt: skip
        session.add_all(floors)
        calibration = Calibration(
            organisation_id=owner.id, device="d", version=1, method="two_step", model={}, fit={}, reference={},
            samples_sha256=put(b"readings"), measured_at=datetime(2026, 3, 29, 1, 30, 0, 123456, tzinfo=UTC),
        )  # fmt: skip
        session.add(calibration)
        session.flush()
        for number, excluded in enumerate((None, [[0.5, 1.25]])):
            session.add(Survey(
                organisation_id=owner.id, floor_id=floors[0].id, name="s", format="csv", frame="building",
                raw_sha256=put(b"raw %d" % number), samples_sha256=put(b"samples %d" % number), sample_count=2,
                report={"warnings": [ODD]}, calibration_id=calibration.id, excluded_s=excluded,
            ))  # fmt: skip
        ready = Map(
            organisation_id=owner.id, floor_id=floors[0].id, status="ready", sequence=1, spec={}, survey_ids=["x"],
            grid_sha256=put(b"grid"), layers_sha256=put(b"layers"), quality_sha256=put(b"quality"),
            state_sha256=put(b"state"), bounds_m=[-0.0, 1e-7, 3.0, 4.0], finished_at=datetime.now(UTC),
        )  # fmt: skip
        asked = Map(organisation_id=owner.id, floor_id=floors[1].id, status="accepted", spec={}, survey_ids=[])
        session.add_all([ready, asked])
        session.flush()
        track = Track(
            organisation_id=owner.id, key_id=key.id, building_id=building.id, frame="level", seed=2**62,
            spec={"maps": [[floors[0].id, ready.id, put(b"pinned grid")]]},
        )  # fmt: skip
        session.add(track)
        session.flush()
        steps = {"track_id": track.id, "next_step": 2**40, "sha256": "b" * 64}
        session.add_all([
            TrackSteps(sequence=0, data=bytes(range(256)), settled=None, **steps),
            TrackSteps(sequence=1, data=b"", settled=[[1, 0.1]], **steps),
            TrackState(track_id=track.id, batches=2, written_by="0", data=b"\x00\xff"),
            Idempotency(organisation_id=owner.id, key="once", fingerprint="c" * 64, status_code=201, body={}),
            Worker(id="w", state="live", beat=datetime.now(UTC)),
        ])  # fmt: skip
        site.queue.enqueue_rebuild(session, floors[0])
        running = site.queue.enqueue_build(session, asked)
        running.status = asked.status = "running"
        running.started_at, running.progress = datetime.now(UTC), 40
