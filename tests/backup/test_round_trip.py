"""What is backed up and restored is the same, whatever database it was and will be in."""

import json
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import func, select, text

from app import __version__
from app.db.engine import create_database_engine, migration_state
from app.db.snapshot import known_revisions, made_at_once, move_schema
from app.db.tables import Base, Job, Map, Organisation, Survey, Worker, new_id
from app.errors import Conflict, InvalidInput
from app.services.backup_archive import ArchiveReader, ArchiveWriter, Manifest, StoredTable
from app.services.make_backup import LEFT_OUT


def without_jobs(rows: dict[str, list[bytes]]) -> dict[str, list[bytes]]:
    """Rows but of jobs that had not ended and of their maps, which begin anew."""
    return {
        name: [line for line in lines if name not in ("job", "map") or not {b'"running"', b'"accepted"'} & set(
            line.replace(b":", b",").split(b","))]
        for name, lines in rows.items()
    }  # fmt: skip


@pytest.mark.postgres
def test_from_sqlite_to_postgresql_and_back_every_row_and_blob_is_the_same(
    site: Any, restore: Callable[..., Any], tmp_path: Path
) -> None:
    before, blobs = site.rows(), site.blob_names()
    assert all(before.values()), "a row of every table"
    made = site.back_up(tmp_path / "1.zip")
    assert (made.blobs, made.damaged, made.gone, made.caches_gone) == (len(blobs), [], [], [])
    there, _ = restore(tmp_path / "1.zip", "postgres")
    assert without_jobs(there.rows()) == without_jobs(before)
    there.back_up(tmp_path / "2.zip")
    back, _ = restore(tmp_path / "2.zip", "sqlite")
    assert back.rows() == there.rows()
    assert back.blob_names() == there.blob_names() == blobs
    for sha256 in blobs:
        assert back.blobs.get(sha256) == site.blobs.get(sha256)


def test_null_and_json_null_stay_what_they_are(site: Any, restore: Callable[..., Any], tmp_path: Path) -> None:
    asked = text("SELECT count(*) FROM floor WHERE plan IS NULL"), text("SELECT plan FROM floor ORDER BY id")

    def seen(one: Any) -> list[object]:
        with one.engine.connect() as connection:
            return [connection.execute(each).all() for each in asked]

    site.back_up(tmp_path / "1.zip")
    there, _ = restore(tmp_path / "1.zip")
    assert seen(there) == seen(site)


def test_jobs_that_had_not_ended_wait_again_in_the_engine(
    site: Any, restore: Callable[..., Any], tmp_path: Path
) -> None:
    site.back_up(tmp_path / "1.zip")
    there, done = restore(tmp_path / "1.zip")
    assert done.jobs == 2
    with there.sessions.begin() as session:
        session.add(Worker(id="first", state="live", beat=datetime.now(UTC), slots=2))
        there.queue.admit(session)
    queued = {each.workflow_id: each for each in there.queue._client.list_workflows()}
    with there.sessions.begin() as session:
        jobs = session.scalars(select(Job)).all()
        assert {job.workflow_id for job in jobs} == set(queued)
        assert {(job.status, job.progress, job.started_at) for job in jobs} == {("accepted", 0, None)}
        assert {each.status for each in queued.values()} == {"ENQUEUED"}
        assert session.scalar(select(func.count()).select_from(Map).where(Map.status == "running")) == 0
        floor = session.get_one(Base.registry._class_registry["Floor"], jobs[0].floor_id)  # type: ignore[index]
        rebuild = next(job for job in jobs if job.kind == "rebuild")
        assert there.queue.enqueue_rebuild(session, floor).id == rebuild.id, "later uploads share the waiting one"


def test_every_table_is_in_a_backup_or_known_to_stay_out(site: Any, tmp_path: Path) -> None:
    site.back_up(tmp_path / "1.zip")
    with ArchiveReader(tmp_path / "1.zip") as archive:
        assert set(archive.manifest.tables) | LEFT_OUT == set(Base.metadata.tables)
        assert archive.manifest.program == __version__
    with zipfile.ZipFile(tmp_path / "1.zip") as members:
        names = members.namelist()
    assert names[-1] == "manifest.json", "written last"


def test_an_archive_of_every_older_schema_is_brought_to_todays(restore: Callable[..., Any], tmp_path: Path) -> None:
    for revision in known_revisions():
        archive = tmp_path / f"{revision}.zip"
        columns = {"id": "text", "name": "text", "created_at": "time"}
        line = json.dumps({"id": "o", "name": revision, "created_at": "2026-01-01T00:00:00+00:00"}).encode() + b"\n"
        manifest = Manifest("0.0.1", revision, "2026-01-01")
        with ArchiveWriter(archive, manifest) as writer:
            writer.add("rows/organisation.ndjson", [line], packed=True)
            manifest.tables["organisation"] = StoredTable(columns, 1)
        there, _ = restore(archive)
        at, head = migration_state(there.engine)
        assert at == head
        with there.sessions() as session:
            assert session.scalars(select(Organisation.name)).all() == [revision]


def test_an_archive_of_a_newer_schema_is_refused(restore: Callable[..., Any], tmp_path: Path) -> None:
    with ArchiveWriter(tmp_path / "1.zip", Manifest("9.0.0", "9999", "2026-01-01")):
        pass
    with pytest.raises(InvalidInput, match=r"9\.0\.0.*newer"):
        restore(tmp_path / "1.zip")


def test_what_is_there_is_never_overwritten(
    site: Any, open_site: Callable[..., Any], new_url: Callable[[str], str], tmp_path: Path
) -> None:
    from app.services.restore_backup import restore_backup

    site.back_up(tmp_path / "1.zip")
    written = (tmp_path / "1.zip").read_bytes()
    with pytest.raises(Conflict, match="never overwritten"):
        site.back_up(tmp_path / "1.zip")
    assert (tmp_path / "1.zip").read_bytes() == written
    before = site.rows()
    with pytest.raises(Conflict, match="not empty"):
        restore_backup(site.url, site.blobs, tmp_path / "1.zip", lambda *_: None)
    assert site.rows() == before


def test_an_empty_schema_that_is_there_already_is_used(
    site: Any, open_site: Callable[..., Any], new_url: Callable[[str], str], tmp_path: Path
) -> None:
    from app.services.restore_backup import restore_backup

    site.back_up(tmp_path / "1.zip")
    there = open_site(new_url("sqlite"), migrated=False)
    restore_backup(there.url, there.blobs, tmp_path / "1.zip", lambda *_: None)
    assert without_jobs(there.rows()) == without_jobs(site.rows())


def test_a_database_of_another_version_is_not_backed_up(new_url: Callable[[str], str], tmp_path: Path) -> None:
    from app.blobs import FolderBlobStore
    from app.services.make_backup import make_backup

    engine = create_database_engine(new_url("sqlite"))
    with made_at_once(engine) as connection:
        move_schema(connection, known_revisions()[0])
    with pytest.raises(Conflict, match="isodyn serve"):
        make_backup(engine, FolderBlobStore(tmp_path / "blobs"), tmp_path / "1.zip", lambda *_: None)
    engine.dispose()
    assert not (tmp_path / "1.zip").exists()


def test_blobs_that_are_gone_are_told(site: Any, restore: Callable[..., Any], tmp_path: Path) -> None:
    with site.sessions() as session:
        row = session.scalars(select(Map).where(Map.status == "ready")).one()
        raw = session.scalars(select(Survey.raw_sha256)).first()
    site.blobs.discard(row.state_sha256)
    site.blobs.discard(row.grid_sha256)
    (tmp_path / site.blobs._path(raw)).write_bytes(b"damaged")
    made = site.back_up(tmp_path / "1.zip")
    assert (made.damaged, made.gone, made.caches_gone) == ([raw], [row.grid_sha256], [row.state_sha256])
    _, done = restore(tmp_path / "1.zip")
    assert done.missing == sorted([raw, row.grid_sha256, row.state_sha256])


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def test_a_backup_is_of_one_moment_while_uploads_run(
    kind: str, new_url: Callable[[str], str], open_site: Callable[..., Any], restore: Callable[..., Any], tmp_path: Path
) -> None:
    """Every upload is two rows and two blobs; an archive has both or neither, and every blob its rows name."""
    site = open_site(new_url(kind), migrated=False)
    stop, uploaded = False, 0

    def upload() -> None:
        nonlocal uploaded
        while not stop:
            sha256 = site.blobs.put(b"upload %d" % uploaded)
            with site.sessions.begin() as session:
                owner = Organisation(id=new_id(), name=f"pair {uploaded}")
                session.add(owner)
                session.flush()
                session.add(Base.registry._class_registry["Calibration"](  # type: ignore[operator]
                    organisation_id=owner.id, device="d", version=1, method="m", model={}, fit={}, reference={},
                    samples_sha256=sha256, measured_at=datetime.fromisoformat("2026-01-01T00:00:00+00:00"),
                ))  # fmt: skip
            uploaded += 1

    archives: list[Path] = []
    with ThreadPoolExecutor(1) as pool:
        uploading = pool.submit(upload)
        try:
            while len(archives) < 6 or (uploaded < 7 and not uploading.done()):  # of few, uploads get few turns
                archives.append(tmp_path / f"{len(archives)}.zip")
                made = site.back_up(archives[-1])
                assert (made.gone, made.damaged) == ([], [])
        finally:
            stop = True
        uploading.result()
    counts = []
    for path in archives:
        with ArchiveReader(path) as archive:
            archive.verify(lambda *_: None)
            owners = [json.loads(line)["id"] for line in archive.lines("organisation")]
            named = [json.loads(line) for line in archive.lines("calibration")]
            assert [each["organisation_id"] for each in named] == owners
            assert {each["samples_sha256"] for each in named} == set(archive.blobs)
            counts.append(len(owners))
    assert counts == sorted(counts)
    assert counts[-1] > counts[0]
    restore(archives[-1])
