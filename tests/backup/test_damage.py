"""An archive that is not what was written is refused with what is wrong, and nothing is stored."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.blobs import FolderBlobStore
from app.errors import CorruptArtefact, IsodynError, NotFound
from app.services.backup_archive import MANIFEST, ArchiveReader
from app.services.restore_backup import restore_backup


def refused(archive: Path, folder: Path) -> str:
    """What is said; and the database is not even begun."""
    with pytest.raises(IsodynError) as raised:
        restore_backup(f"sqlite:///{folder / 'new' / 'isodyn.db'}", FolderBlobStore(folder / "b"), archive, quiet)
    assert not (folder / "new").exists()
    assert list(FolderBlobStore(folder / "b").stored()) == []
    return str(raised.value)


def quiet(_what: str, _done: int, _total: int) -> None: ...


def rewritten(source: Path, target: Path, change: Callable[[str, bytes], bytes | None]) -> Path:
    """The archive with its members changed, and sound as a ZIP file."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for name in old.namelist():
            data = change(name, old.read(name))
            if data is not None:
                new.writestr(name, data)
    return target


def test_what_is_wrong_is_said(site: Any, tmp_path: Path) -> None:
    good = tmp_path / "good.zip"
    site.back_up(good)
    whole, bad = good.read_bytes(), tmp_path / "bad.zip"
    with pytest.raises(NotFound, match="no archive"):
        ArchiveReader(tmp_path / "none.zip")
    for part in (0, 10, len(whole) // 2, len(whole) - 1):
        bad.write_bytes(whole[:part])
        assert "cut short" in refused(bad, tmp_path)
    bad.write_bytes(b"PK" + b"nonsense" * 100)
    assert "not a backup" in refused(bad, tmp_path)
    raw = site.blob_names()[0]
    at = whole.index(site.blobs.get(raw))
    bad.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    assert f"blobs/{raw} is damaged" in refused(bad, tmp_path)
    rewritten(good, bad, lambda name, data: data.replace(b"csv", b"CSV") if "survey" in name else data)
    assert "rows/survey.ndjson is damaged" in refused(bad, tmp_path)
    rewritten(good, bad, lambda name, data: None if "survey" in name else data)
    assert "rows/survey.ndjson" in refused(bad, tmp_path)
    rewritten(good, bad, lambda name, data: None if name == MANIFEST else data)
    assert "manifest" in refused(bad, tmp_path)
    rewritten(good, bad, lambda name, data: data.replace(b"backup-1", b"backup-2") if name == MANIFEST else data)
    assert "isodyn-backup-2" in refused(bad, tmp_path)
    rewritten(good, bad, lambda name, data: data.replace(raw.encode(), b"0" * 64) if name == MANIFEST else data)
    assert "members" in refused(bad, tmp_path)


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), cut=st.booleans())
def test_any_damage_is_refused_or_harmless(site: Any, tmp_path: Path, place: float, flip: int, cut: bool) -> None:
    good, bad = tmp_path / "good.zip", tmp_path / "bad.zip"
    if not good.exists():
        site.back_up(good)
    whole = good.read_bytes()
    at = int(place * len(whole))
    bad.write_bytes(whole[:at] if cut else whole[:at] + bytes([whole[at] ^ flip]) + whole[at + 1 :])
    with ArchiveReader(good) as sound:
        try:
            with ArchiveReader(bad) as archive:
                archive.verify(quiet)
                assert not cut
                for name in sound.manifest.tables:
                    assert list(archive.lines(name)) == list(sound.lines(name))
                assert [archive.blob(each) for each in archive.blobs] == [sound.blob(each) for each in sound.blobs]
        except IsodynError:
            return


def test_rows_that_a_database_refuses_leave_nothing(site: Any, tmp_path: Path) -> None:
    """A key of another row that is not there: only the database notices."""
    import hashlib
    import json

    good, bad = tmp_path / "good.zip", tmp_path / "bad.zip"
    site.back_up(good)
    with ArchiveReader(good) as archive:
        (building,) = archive.lines("building")
    broken = json.dumps({**json.loads(building), "organisation_id": "nobody"}).encode() + b"\n"

    def change(name: str, data: bytes) -> bytes:
        if name == "rows/building.ndjson":
            return broken
        if name == MANIFEST:
            told = json.loads(data)
            told["members"]["rows/building.ndjson"] = {
                "size_bytes": len(broken), "sha256": hashlib.sha256(broken).hexdigest(),
            }  # fmt: skip
            return json.dumps(told).encode()
        return data

    rewritten(good, bad, change)
    url, blobs = f"sqlite:///{tmp_path / 'new' / 'isodyn.db'}", FolderBlobStore(tmp_path / "b")
    with pytest.raises(IsodynError, match="building"):
        restore_backup(url, blobs, bad, quiet)
    assert restore_backup(url, blobs, good, quiet).rows > 0, "the database is as empty as before"


def test_a_full_disk_leaves_no_archive(site: Any, tmp_path: Path) -> None:
    site.blobs.discard(site.blob_names()[0])

    class Full(FolderBlobStore):
        def get(self, sha256: str) -> bytes:
            raise OSError(28, "No space left on device")

    from app.services.make_backup import make_backup

    folder = tmp_path / "archives"
    folder.mkdir()
    with pytest.raises(OSError, match="No space"):
        make_backup(site.engine, Full(tmp_path / "full"), folder / "1.zip", quiet)
    assert list(folder.iterdir()) == []


def test_a_blob_that_is_not_its_hash_is_refused(site: Any, tmp_path: Path) -> None:
    """Also where the manifest agrees with what is in the archive."""
    import hashlib

    good, bad, raw = tmp_path / "good.zip", tmp_path / "bad.zip", site.blob_names()[0]
    site.back_up(good)
    other = bytes(len(site.blobs.get(raw)))
    digest = hashlib.sha256(other).hexdigest().encode()

    def change(name: str, data: bytes) -> bytes:
        if name == MANIFEST:
            return data.replace(f'"sha256": "{raw}"'.encode(), b'"sha256": "%b"' % digest)
        return other if name == f"blobs/{raw}" else data

    with ArchiveReader(rewritten(good, bad, change)) as archive, pytest.raises(CorruptArtefact, match=raw):
        archive.verify(quiet)
