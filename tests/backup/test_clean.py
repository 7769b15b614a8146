"""Cleaning deletes what nobody names, and never what somebody needs."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from hashlib import sha256 as sha256_of
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from sqlalchemy import delete

from app.blobs import BlobStore, FolderBlobStore
from app.db.tables import Building, Calibration, Floor, Map, Organisation, Survey, new_id
from app.errors import Conflict
from app.services.check_blobs import check_blobs
from app.services.clean_blobs import Cleaned, clean_blobs

DAY = timedelta(days=1)


def quiet(_what: str, _done: int, _total: int) -> None: ...


def clean(site: Any, blobs: BlobStore | None = None, dry_run: bool = False) -> Cleaned:
    return clean_blobs(site.sessions, site.queue, blobs or site.blobs, DAY, dry_run, quiet)


def make_old(blobs: FolderBlobStore, sha256: str, days: float = 2.0) -> None:
    at = datetime.now(UTC).timestamp() - days * 86_400
    os.utime(blobs._path(sha256), (at, at))


@pytest.fixture
def bare(new_url: Callable[[str], str], open_site: Callable[..., Any]) -> Any:
    """An installation with an organisation and a floor, and nothing else."""
    site = open_site(new_url("sqlite"), migrated=False)
    with site.sessions.begin() as session:
        session.add(Organisation(id="o", name="o"))
        session.flush()
        session.add(Building(id="b", organisation_id="o", name="b"))
        session.flush()
        session.add(Floor(id="f", organisation_id="o", building_id="b", name="f", ordinal=0, elevation_m=0.0))
    return site


def name_in(session: Any, where: str, sha256: str) -> None:
    """A row that names a blob."""
    if where == "calibration":
        session.add(Calibration(
            organisation_id="o", device=new_id(), version=1, method="m", model={}, fit={}, reference={},
            samples_sha256=sha256, measured_at=datetime.now(UTC),
        ))  # fmt: skip
    elif where == "plan":
        session.get_one(Floor, "f").plan = {"sha256": sha256}
    elif where == "raw":
        session.add(Survey(
            organisation_id="o", floor_id="f", name="s", format="csv", frame=new_id()[-12:], raw_sha256=sha256,
            samples_sha256=sha256, sample_count=1, report={},
        ))  # fmt: skip
    else:
        session.add(Map(organisation_id="o", floor_id="f", status="ready", spec={}, survey_ids=[], **{where: sha256}))


def test_only_the_old_that_nobody_names_goes(site: Any) -> None:
    named = site.blob_names()
    old, young = site.blobs.put(b"old orphan"), site.blobs.put(b"young orphan")
    for sha256 in (*named, old):
        make_old(site.blobs, sha256)
    assert clean(site, dry_run=True) == Cleaned(1, len(b"old orphan"), 1)
    assert site.blobs.exists(old)
    assert clean(site) == Cleaned(1, len(b"old orphan"), 1)
    assert site.blob_names() == sorted([*named, young])
    assert clean(site) == Cleaned(0, 0, 1)


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    state=st.lists(
        st.tuples(
            st.sampled_from(["calibration", "plan", "raw", "grid_sha256", "layers_sha256", "state_sha256", None]),
            st.integers(0, 12),
            st.sampled_from([0.0, 0.5, 1.5, 400.0]),
        ),
        max_size=12,
    )
)
def test_whatever_is_named_is_never_deleted(bare: Any, state: list[tuple[str | None, int, float]]) -> None:
    ages: dict[str, float] = {}
    named: dict[str, str] = {}
    with bare.sessions.begin() as session:
        for table in (Calibration, Survey, Map):
            session.execute(delete(table))
        session.get_one(Floor, "f").plan = None
        session.flush()
        for where, content, age in state:
            sha256 = bare.blobs.put(b"content %d" % content)
            ages[sha256] = age
            if where is None:
                continue
            name_in(session, where, sha256)
            named = {key: value for key, value in named.items() if where != "plan" or value != "plan"}
            named[f"{where} {len(named)} {content}"] = "plan" if where == "plan" else where
        plan = session.get_one(Floor, "f").plan
        keys = {key for key, value in named.items() if value != "plan"}
        needed = {sha256_of(b"content %s" % key.split()[-1].encode()).hexdigest() for key in keys}
        needed |= {plan["sha256"]} if plan else set()
    for sha256, age in ages.items():
        make_old(bare.blobs, sha256, age)
    clean(bare)
    left = set(bare.blob_names())
    assert needed <= left
    assert left == needed | {sha256 for sha256, age in ages.items() if age < 1.0}
    for sha256 in left:
        bare.blobs.discard(sha256)


def test_most_of_a_store_is_not_deleted_unasked(bare: Any) -> None:
    """It may be the store of another database."""
    for number in range(30):
        make_old(bare.blobs, bare.blobs.put(b"of another database %d" % number))
    with pytest.raises(Conflict, match="ISODYN_DATABASE_URL"):
        clean(bare)
    assert len(bare.blob_names()) == 30
    assert clean(bare, dry_run=True).blobs == 30
    assert clean_blobs(bare.sessions, bare.queue, bare.blobs, DAY, False, quiet, even_most=True).blobs == 30


class Meddler(FolderBlobStore):
    """Lets somebody in at the worst moments: just before a blob is discarded by age."""

    def __init__(self, folder: Path, meddle: Callable[[str], None]) -> None:
        super().__init__(folder)
        self._meddle = meddle

    def discard_older(self, sha256: str, before: datetime) -> bool:
        self._meddle(sha256)
        return super().discard_older(sha256, before)


def test_an_orphan_that_is_uploaded_again_at_the_last_moment_stays(bare: Any) -> None:
    """After the references were looked at for the last time, before the blob is discarded."""
    sha256 = bare.blobs.put(b"walk")
    make_old(bare.blobs, sha256)

    def upload(wanted: str) -> None:
        assert bare.blobs.put(b"walk") == wanted
        with bare.sessions.begin() as session:
            name_in(session, "raw", wanted)

    assert clean(bare, Meddler(bare.blobs._folder, upload)).blobs == 0
    assert bare.blobs.get(sha256) == b"walk"


@pytest.mark.parametrize("rounds", [6, pytest.param(300, marks=pytest.mark.slow)])
def test_uploads_race_with_cleaning(bare: Any, rounds: int) -> None:
    """Old orphans are uploaded again while others clean; whatever an upload acknowledged can be read."""
    contents = [b"walk %d" % number for number in range(12)]
    lost: list[str] = []

    def upload(content: bytes) -> None:
        sha256 = bare.blobs.put(content)
        with bare.sessions.begin() as session:
            name_in(session, "calibration", sha256)
        if not bare.blobs.exists(sha256):
            lost.append(sha256)

    with ThreadPoolExecutor(6) as pool:
        for _ in range(rounds):
            with bare.sessions.begin() as session:
                session.execute(delete(Calibration))
            for content in contents:
                make_old(bare.blobs, bare.blobs.put(content))
            work = [
                pool.submit(clean, bare),
                *(pool.submit(upload, each) for each in contents),
                pool.submit(clean, bare),
            ]
            for each in work:
                each.result()
            for content in contents:
                assert bare.blobs.get(sha256_of(content).hexdigest()) == content
    assert lost == []


def test_a_deep_look(site: Any) -> None:
    names = site.blob_names()
    with site.sessions() as session:
        row = session.query(Map).filter(Map.status == "ready").one()
        raw = session.query(Survey).first().raw_sha256
    site.blobs.discard(row.grid_sha256)
    site.blobs.discard(row.state_sha256)
    site.blobs._path(raw).write_bytes(b"damaged")
    old = site.blobs.put(b"old orphan")
    make_old(site.blobs, old)
    site.blobs.put(b"young orphan")
    (site.blobs._path(raw).parent / "note.txt").write_text("somebody else's")
    health = check_blobs(site.sessions, site.queue, site.blobs, datetime.now(UTC) - DAY, quiet)
    assert [each.sha256 for each in health.damaged] == [raw]
    assert health.missing == [row.grid_sha256]
    assert health.missing_caches == [row.state_sha256]
    assert [each.sha256 for each in health.orphaned] == [old]
    assert health.young == 1
    assert health.checked == len(names) - 3 + 2
    assert health.named.named_by(raw) == ["survey.raw_sha256"]
