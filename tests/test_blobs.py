"""One contract for every blob store, and what the folder store promises beyond it."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.blobs import BlobStore, FolderBlobStore, open_blob_store
from app.errors import CorruptArtefact, InvalidInput, NotFound, Unavailable

ROOT = Path(__file__).parents[1]
ABSENT = hashlib.sha256(b"never stored").hexdigest()


class BlobStoreContract(ABC):
    """Every store passes this: inherit, and say how to open a store (twice: the same blobs) and how to damage one."""

    @abstractmethod
    def open(self, place: Path) -> BlobStore: ...

    @abstractmethod
    def damage(self, place: Path, sha256: str) -> None: ...

    @settings(
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.differing_executors], deadline=None
    )
    @given(data=st.binary(max_size=3000))
    def test_what_is_put_is_got(self, tmp_path: Path, data: bytes) -> None:
        store = self.open(tmp_path)
        sha256 = store.put(data)
        assert sha256 == hashlib.sha256(data).hexdigest()
        assert store.exists(sha256)
        assert store.get(sha256) == data

    def test_putting_again_changes_nothing(self, tmp_path: Path) -> None:
        store = self.open(tmp_path)
        assert store.put(b"magnetite") == store.put(b"magnetite")
        assert store.get(store.put(b"magnetite")) == b"magnetite"

    def test_it_lists_what_it_holds(self, tmp_path: Path) -> None:
        store = self.open(tmp_path)
        held = {store.put(data): len(data) for data in (b"", b"magnetite", b"x" * 5000)}
        listed = list(store.stored())
        assert {each.sha256: each.size_bytes for each in listed} == held
        assert [each.sha256 for each in listed] == sorted(held)
        assert all(abs((datetime.now(UTC) - each.stored_at).total_seconds()) < 60 for each in listed)
        store.discard(listed[0].sha256)
        assert len(list(store.stored())) == 2

    def test_putting_again_makes_a_blob_young(self, tmp_path: Path) -> None:
        store = self.open(tmp_path)
        sha256 = store.put(b"magnetite")
        first = next(store.stored()).stored_at
        time.sleep(1.1)  # stores may tell whole seconds only
        store.put(b"magnetite")
        assert next(store.stored()).stored_at > first
        assert not store.discard_older(sha256, first + timedelta(seconds=0.5))
        assert store.exists(sha256)

    def test_an_old_blob_is_discarded_once(self, tmp_path: Path) -> None:
        store = self.open(tmp_path)
        sha256 = store.put(b"magnetite")
        later = datetime.now(UTC) + timedelta(hours=1)
        assert store.discard_older(sha256, later)
        assert not store.exists(sha256)
        assert not store.discard_older(sha256, later)
        with pytest.raises(NotFound):
            store.discard_older("../lock", later)

    def test_blobs_outlive_the_store_object(self, tmp_path: Path) -> None:
        sha256 = self.open(tmp_path).put(b"magnetite")
        assert self.open(tmp_path).get(sha256) == b"magnetite"

    def test_a_discarded_blob_is_gone_and_can_be_put_again(self, tmp_path: Path) -> None:
        store = self.open(tmp_path)
        sha256 = store.put(b"magnetite")
        store.discard(sha256)
        store.discard(sha256)
        assert not store.exists(sha256)
        assert store.get(store.put(b"magnetite")) == b"magnetite"

    def test_an_absent_blob_is_not_found(self, tmp_path: Path) -> None:
        store = self.open(tmp_path)
        assert not store.exists(ABSENT)
        with pytest.raises(NotFound, match=ABSENT):
            store.get(ABSENT)

    @pytest.mark.parametrize("name", ["", "..", "../../etc/passwd", ABSENT.upper(), ABSENT + "0", ABSENT[:-1] + "/"])
    def test_a_name_that_is_no_hash_is_not_found(self, tmp_path: Path, name: str) -> None:
        store = self.open(tmp_path)
        with pytest.raises(NotFound):
            store.exists(name)
        with pytest.raises(NotFound):
            store.get(name)

    def test_damage_is_seen_and_putting_again_repairs_it(self, tmp_path: Path) -> None:
        store = self.open(tmp_path)
        sha256 = store.put(b"magnetite")
        self.damage(tmp_path, sha256)
        with pytest.raises(CorruptArtefact, match=sha256):
            store.get(sha256)
        store.put(b"magnetite")
        assert store.get(sha256) == b"magnetite"

    def test_many_put_the_same_at_once(self, tmp_path: Path) -> None:
        data = os.urandom(200_000)
        with ThreadPoolExecutor(8) as pool:
            names = set(pool.map(lambda _: self.open(tmp_path).put(data), range(24)))
        assert names == {hashlib.sha256(data).hexdigest()}
        assert self.open(tmp_path).get(names.pop()) == data


class TestFolderBlobStore(BlobStoreContract):
    def open(self, place: Path) -> BlobStore:
        return FolderBlobStore(place / "blobs")

    def damage(self, place: Path, sha256: str) -> None:
        (place / "blobs" / sha256[:2] / sha256[2:4] / sha256).write_bytes(b"magnetit")

    def test_discarding_by_age_never_takes_what_a_put_acknowledges(self, tmp_path: Path) -> None:
        """Every put finds an old blob that somebody discards at that moment; what it acknowledges is there."""
        store, data = FolderBlobStore(tmp_path / "blobs"), b"magnetite"
        sha256 = store.put(data)
        file = tmp_path / "blobs" / sha256[:2] / sha256[2:4] / sha256
        for _ in range(300):
            os.utime(file, (0, 0))
            with ThreadPoolExecutor(2) as pool:
                discarding = [pool.submit(store.discard_older, sha256, datetime(2000, 1, 1, tzinfo=UTC))]
                putting = pool.submit(store.put, data)
            discarding[0].result()
            assert putting.result() == sha256
            assert store.get(sha256) == data

    def test_nothing_but_blobs_is_left(self, tmp_path: Path) -> None:
        self.open(tmp_path).put(b"magnetite")
        assert {file.name for file in tmp_path.rglob("*") if file.is_file()} == {
            hashlib.sha256(b"magnetite").hexdigest(),
            "lock",
        }

    def test_killed_in_the_middle_of_a_put_nothing_is_visible(self, tmp_path: Path) -> None:
        """Killed again and again at other moments: every blob to be seen is whole."""
        code = (
            "import hashlib, sys; from pathlib import Path; from app.blobs import FolderBlobStore\n"
            "store = FolderBlobStore(Path(sys.argv[1])); print('ready', flush=True)\n"
            "for n in range(10_000): store.put(bytes([n % 251]) * 20_000_000 + str(n).encode())\n"
        )
        folder = tmp_path / "blobs"
        for kill_after_s in (0.01, 0.03, 0.06, 0.1, 0.15):
            child = subprocess.Popen(
                [sys.executable, "-c", code, str(folder)],
                stdout=subprocess.PIPE,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
            )
            assert child.stdout is not None
            with child.stdout:
                child.stdout.readline()
                time.sleep(kill_after_s)
                child.send_signal(signal.SIGKILL)
                child.wait()
            store = FolderBlobStore(folder)
            for file in folder.rglob("*"):
                if file.is_file() and file.parent.name != "tmp":
                    store.get(file.name)
                    file.unlink()

    def test_a_full_disk_leaves_nothing(self, tmp_path: Path) -> None:
        code = (
            "import resource, signal, sys; from pathlib import Path; from app.blobs import FolderBlobStore\n"
            "from app.errors import Unavailable\n"
            "store = FolderBlobStore(Path(sys.argv[1])); signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))\n"
            "try: store.put(b'x' * 5000)\n"
            "except Unavailable: sys.exit(7)\n"
        )
        run = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path)], env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False
        )
        assert run.returncode == 7
        assert [file for file in tmp_path.rglob("*") if file.is_file() and file.name != "lock"] == []


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 1 MiB. Without the right to mount one the test is skipped, but where `CI` is set it fails."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", place], capture_output=True, text=True)
    if mounted.returncode:
        reason = f"no disk can be mounted here: {mounted.stderr.strip()}"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    yield place
    subprocess.run(["umount", "--lazy", place], check=False)


def test_what_a_disk_refuses_is_for_now_and_is_said(disk: Path) -> None:
    store = FolderBlobStore(disk / "blobs")
    kept = store.put(b"magnetite")
    with pytest.raises(Unavailable, match=r"no space left on device.*isodyn clean"):
        store.put(os.urandom(2**20))
    assert store.get(kept) == b"magnetite"
    assert [blob.sha256 for blob in store.stored()] == [kept]
    subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
    for refused in (lambda: store.put(b"hematite"), lambda: store.discard(kept)):
        with pytest.raises(Unavailable, match=r"read-only file system.*mount it for writing"):
            refused()
    assert FolderBlobStore(disk / "blobs").get(kept) == b"magnetite"
    subprocess.run(["mount", "-o", "remount,rw", disk], check=True)
    assert store.get(store.put(b"hematite")) == b"hematite"
    subprocess.run(["umount", "--lazy", disk], check=True)
    for missed in (lambda: store.get(kept), lambda: store.exists(kept), lambda: store.put(b"goethite")):
        with pytest.raises(Unavailable, match="is its disk mounted"):
            missed()


def test_a_folder_that_may_not_be_read_is_for_now(tmp_path: Path) -> None:
    store = FolderBlobStore(tmp_path / "blobs")
    kept = store.put(b"magnetite")
    (tmp_path / "blobs").chmod(0)
    me = os.geteuid()
    try:
        if me == 0:  # whom nothing is forbidden
            os.seteuid(65534)
        for refused in (lambda: store.get(kept), lambda: store.exists(kept), lambda: store.put(b"hematite")):
            with pytest.raises(Unavailable, match="may not read or write there"):
                refused()
    finally:
        os.seteuid(me)
        (tmp_path / "blobs").chmod(0o700)
    assert store.exists(kept)


def test_addresses(tmp_path: Path) -> None:
    folder = tmp_path / "my blobs"
    sha256 = open_blob_store(f"file://{folder}".replace(" ", "%20")).put(b"magnetite")
    assert open_blob_store(f"file://{folder}").get(sha256) == b"magnetite"
    for url in ("blobs", "file://host/folder", "file:blobs", "http://host/"):
        with pytest.raises(InvalidInput, match="file:///FOLDER"):
            open_blob_store(url)
