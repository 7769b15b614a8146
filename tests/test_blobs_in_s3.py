"""Blobs in S3 keep the contract of every store, and do so when the server is gone, refuses, or dies in between.

Against a server of the S3 API on this machine, never a stand-in for the client.
"""

import hashlib
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from uuid import uuid4

import pytest

from app.blobs import BlobStore, FolderBlobStore, S3BlobStore, open_blob_store
from app.blobs import s3 as s3_module
from app.cli.doctor import examine
from app.errors import CorruptArtefact, InvalidInput, NotFound, Unavailable
from app.settings import Settings
from tests.s3_server import BUCKET, Server, Way, free_port
from tests.test_blobs import ABSENT, BlobStoreContract
from workers.fit_process import FitProcesses

pytestmark = pytest.mark.s3
ROOT = Path(__file__).parents[1]


@pytest.fixture
def address(s3: Server) -> str:
    """Of an empty store of the test's own."""
    return f"s3://{BUCKET}/{uuid4().hex}"


@pytest.fixture
def way(s3: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Way]:
    """The environment leads to the server by a way that can be cut."""
    way = Way(s3.port)
    monkeypatch.setenv("AWS_ENDPOINT_URL", way.url)
    yield way
    way.close()


def every_verb(store: BlobStore) -> dict[str, Callable[[], object]]:
    return {
        "put": lambda: store.put(b"magnetite"),
        "get": lambda: store.get(ABSENT),
        "exists": lambda: store.exists(ABSENT),
        "discard": lambda: store.discard(ABSENT),
        "stored": lambda: list(store.stored()),
    }


VERBS = ["put", "get", "exists", "discard", "stored"]


class TestS3BlobStore(BlobStoreContract):
    @pytest.fixture(autouse=True)
    def reach(self, s3: Server) -> None:
        self.server = s3

    def open(self, place: Path) -> BlobStore:
        return S3BlobStore(f"s3://{BUCKET}{place}")

    def damage(self, place: Path, sha256: str) -> None:
        self.server.ask("PUT", f"/{BUCKET}{place}/{sha256[:2]}/{sha256[2:4]}/{sha256}", b"magnetit")


def test_a_folder_can_be_copied_into_a_bucket_as_it_is(s3: Server, address: str, tmp_path: Path) -> None:
    folder = FolderBlobStore(tmp_path)
    names = {folder.put(data) for data in (b"", b"magnetite", b"greigite")}
    prefix = address.removeprefix("s3://")
    for file in tmp_path.rglob("*"):
        if file.is_file():
            s3.ask("PUT", f"/{prefix}/{file.relative_to(tmp_path)}", file.read_bytes())
    assert {each.sha256 for each in open_blob_store(address).stored()} == names


def test_stores_beside_each_other_and_strange_objects_are_not_listed(s3: Server, address: str) -> None:
    store = open_blob_store(address)
    sha256 = store.put(b"magnetite")
    open_blob_store(f"{address}-2").put(b"greigite")
    for name in ("tmp/x", "readme.txt", f"{sha256}", f"00/00/{sha256}"):
        s3.ask("PUT", f"/{address.removeprefix('s3://')}/{name}", b"x")
    assert [each.sha256 for each in store.stored()] == [sha256]


@pytest.mark.slow
def test_many_pages_are_listed(address: str) -> None:
    store = open_blob_store(address)
    with ThreadPoolExecutor(8) as pool:
        names = set(pool.map(lambda n: store.put(str(n).encode()), range(2500)))
    listed = [each.sha256 for each in store.stored()]
    assert listed == sorted(names)
    assert len(listed) == 2500


def test_twenty_threads_share_a_store(address: str) -> None:
    store = open_blob_store(address)
    same = os.urandom(300_000)

    def work(number: int) -> tuple[str, str]:
        own = number.to_bytes(4, "big") * 20_000
        names = store.put(same), store.put(own)
        assert store.get(names[0]) == same
        assert store.get(names[1]) == own
        return names

    with ThreadPoolExecutor(20) as pool:
        names = list(pool.map(work, range(40)))
    assert {first for first, _ in names} == {hashlib.sha256(same).hexdigest()}
    assert len(list(store.stored())) == 41


def test_a_blob_put_again_is_young_again(address: str) -> None:
    """What was put of late may be about to be named by a row, also where the bytes were there."""
    store = open_blob_store(address)
    store.put(b"magnetite")
    time.sleep(1.1)  # S3 counts whole seconds
    again = datetime.now(UTC)
    store.put(b"magnetite")
    (blob,) = store.stored()
    assert blob.stored_at >= again - timedelta(seconds=1)


@pytest.mark.parametrize("verb", VERBS)
def test_a_server_that_is_not_there_is_unavailable(
    s3: Server, monkeypatch: pytest.MonkeyPatch, address: str, verb: str
) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
    with pytest.raises(Unavailable, match="cannot be reached"):
        every_verb(open_blob_store(address))[verb]()


@pytest.mark.parametrize("verb", VERBS)
def test_a_bucket_that_is_not_there_is_named(s3: Server, verb: str) -> None:
    with pytest.raises(Unavailable, match="make the bucket no-such-bucket"):
        every_verb(open_blob_store("s3://no-such-bucket/prefix"))[verb]()


@pytest.mark.parametrize("verb", VERBS)
def test_a_key_that_is_refused_is_told_with_what_it_needs(s3: Server, address: str, verb: str) -> None:
    with s3.check_keys(), pytest.raises(Unavailable, match="AWS_SECRET_ACCESS_KEY") as caught:
        every_verb(open_blob_store(address))[verb]()
    assert "testing" not in str(caught.value)


@pytest.mark.parametrize("verb", VERBS)
def test_another_server_s_404_is_not_taken_for_an_absent_blob(
    s3: Server, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, verb: str
) -> None:
    port = free_port()
    web = subprocess.Popen(
        [sys.executable, "-m", "http.server", str(port), "--bind", "127.0.0.1", "--directory", str(tmp_path)],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        while True:
            try:
                socket.create_connection(("127.0.0.1", port)).close()
                break
            except OSError:
                time.sleep(0.05)
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        with pytest.raises(Unavailable):
            every_verb(open_blob_store("s3://bucket"))[verb]()
    finally:
        web.terminate()
        web.wait()


@pytest.mark.parametrize("verb", VERBS)
def test_a_server_that_never_answers_is_given_up(
    s3: Server, monkeypatch: pytest.MonkeyPatch, address: str, verb: str
) -> None:
    monkeypatch.setattr(s3_module, "REQUEST_S", 1)
    monkeypatch.setattr(s3_module, "RETRY_WITHIN_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        with pytest.raises(Unavailable, match="cannot be reached"):
            every_verb(open_blob_store(address))[verb]()


def test_plain_http_only_where_the_endpoint_says_so(s3: Server, monkeypatch: pytest.MonkeyPatch, address: str) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", s3.url.replace("http://", "https://"))
    with pytest.raises(Unavailable):
        open_blob_store(address).put(b"magnetite")


def test_the_server_dies_in_mid_put_again_and_again_and_nothing_acknowledged_is_lost(way: Way, address: str) -> None:
    """Cut after more and more bytes: within the head, the body, and the next blob; the store is the same throughout."""
    store = open_blob_store(address)
    acknowledged: dict[str, bytes] = {}
    failed = 0
    for cut_after in (100, 1_000, 200_000, 500_000, 900_000, 1_500_000, 2_300_000):
        way.cut()
        way.mend(cut_after)
        for _ in range(3):
            data = os.urandom(700_000)
            try:
                acknowledged[store.put(data)] = data
            except Unavailable:
                failed += 1
                break
    way.cut()
    way.mend()
    assert failed >= 5
    assert len(acknowledged) >= 2
    for sha256, data in acknowledged.items():
        assert store.get(sha256) == data
    for each in store.stored():  # what was not acknowledged is there whole, or not at all
        assert len(store.get(each.sha256)) == 700_000


def test_a_server_that_comes_back_within_the_retries_is_not_missed(way: Way, address: str) -> None:
    store = open_blob_store(address)
    sha256 = store.put(b"magnetite")
    with ThreadPoolExecutor(1) as pool:
        way.cut()
        got = pool.submit(store.get, sha256)
        time.sleep(0.05)
        way.mend()
        assert got.result() == b"magnetite"


def test_a_fork_of_a_process_that_used_it_is_refused_and_not_kept_waiting(address: str) -> None:
    code = (
        "import os, sys; from app.blobs import open_blob_store\n"
        "store = open_blob_store(sys.argv[1])\n"
        "def child():\n"
        "    if os.fork(): return os.waitstatus_to_exitcode(os.wait()[1])\n"
        "    try: store.put(b'child')\n"
        "    except RuntimeError as error: os._exit(7 if 'start a new process' in str(error) else 8)\n"
        "    os._exit(0)\n"
        "before = child(); store.put(b'parent'); after = child()\n"
        "print(before, after, len(list(store.stored())))\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, address], env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=60,
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout.split() == ["0", "7", "2"]


def test_a_fit_s_process_has_a_client_of_its_own(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ISODYN_TEST_DIARY", str(tmp_path / "diary"))
    store = open_blob_store(address)
    store.put(b"the parent's client is in use")
    plan = {"floor_id": "f", "map_id": "m", "surveys": ["one"], "sleep_s": 0.1}
    fits = FitProcesses()
    result = fits.run("tests.jobs.fake_builder", {"plan": plan}, address, lambda fraction, message: None)
    fits.close()
    assert re.search(r"[0-9a-f]{64}", str(result))
    assert len(list(store.stored())) == 2


def test_a_fit_without_its_blobs_is_worth_another_try(
    s3: Server, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ISODYN_TEST_DIARY", str(tmp_path / "diary"))
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
    plan = {"floor_id": "f", "map_id": "m", "surveys": ["one"], "sleep_s": 0.1}
    with pytest.raises(Unavailable, match="cannot be reached"):
        FitProcesses().run("tests.jobs.fake_builder", {"plan": plan}, address, lambda fraction, message: None)


def test_the_doctor_writes_and_reads_and_leaves_nothing(s3: Server, address: str, tmp_path: Path) -> None:
    findings = {f.what: f for f in examine(Settings(data_dir=tmp_path, blob_url=address))}
    assert findings["blob store"].ok is True
    assert address in findings["blob store"].seen
    assert not list(open_blob_store(address).stored())


def test_the_doctor_says_what_is_wrong_with_a_bucket(
    s3: Server, address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def finding(blob_url: str) -> tuple[bool | None, str, str]:
        found = {f.what: f for f in examine(Settings(data_dir=tmp_path, blob_url=blob_url))}["blob store"]
        return found.ok, found.seen, found.advice

    ok, _, advice = finding("s3://no-such-bucket")
    assert (ok, "make the bucket" in advice) == (False, True)
    with s3.check_keys():
        ok, _, advice = finding(address)
    assert (ok, "AWS_SECRET_ACCESS_KEY" in advice) == (False, True)
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{free_port()}")
    ok, seen, _ = finding(address)
    assert (ok, "error sending request" in seen) == (False, True)


def test_damage_by_a_truncated_object_is_seen(s3: Server, address: str) -> None:
    store = open_blob_store(address)
    sha256 = store.put(b"magnetite" * 1000)
    s3.ask("PUT", f"/{address.removeprefix('s3://')}/{sha256[:2]}/{sha256[2:4]}/{sha256}", b"magnetite" * 999)
    with pytest.raises(CorruptArtefact, match="backup"):
        store.get(sha256)
    s3.ask("DELETE", f"/{address.removeprefix('s3://')}/{sha256[:2]}/{sha256[2:4]}/{sha256}")
    with pytest.raises(NotFound, match="bucket"):
        store.get(sha256)


@pytest.mark.parametrize(
    "url",
    ["s3://", "s3://ab", "s3://Bucket", "s3://bucket//x", "s3://bucket/../x", "s3://bucket/a?b=c", "s3://bucket/%2e"],
)
def test_what_is_no_address_is_refused(url: str) -> None:
    with pytest.raises(InvalidInput, match="s3://BUCKET/PREFIX"):
        open_blob_store(url)


def test_a_secret_in_an_address_is_not_repeated() -> None:
    with pytest.raises(InvalidInput, match="AWS_SECRET_ACCESS_KEY") as caught:
        open_blob_store("s3://key:hunter2@bucket/prefix")
    assert "hunter2" not in str(caught.value)


@pytest.mark.parametrize("endpoint", ["localhost:9000", "ftp://host", "https://key:hunter2@host"])
def test_what_is_no_endpoint_is_refused(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    with pytest.raises(InvalidInput, match="AWS_ENDPOINT_URL") as caught:
        open_blob_store("s3://bucket")
    assert "hunter2" not in str(caught.value)


def test_the_key_may_lie_in_a_file(address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    file = tmp_path / "credentials"
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(file))
    with pytest.raises(InvalidInput, match="AWS_SHARED_CREDENTIALS_FILE"):
        open_blob_store(address).put(b"magnetite")
    file.write_text("[default]\naws_access_key_id = testing\naws_secret_access_key = hunter2%\n")
    store = open_blob_store(address)
    assert store.get(store.put(b"magnetite")) == b"magnetite"
