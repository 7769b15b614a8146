"""Blobs in a folder and in S3, side by side: put (new bytes) and get of 10 kB, 1 MB and 20 MB.

Run: python benchmarks/blob_stores.py. S3 is ISODYN_BLOB_URL (s3://BUCKET/PREFIX, with AWS_*; what is put is discarded),
by default a server of its API on this machine in a process of its own: moto's, in memory and in Python, so the figures
are what the API costs without a network and without disks, not what a bucket does. A folder's put is forced to the
disk. Half a minute at most. Exits non-zero when what is got is not what was put, or a size was not measured.
"""

import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from pathlib import Path
from statistics import median
from typing import TypeVar

from app.blobs import BlobStore, FolderBlobStore, open_blob_store

A = TypeVar("A")
B = TypeVar("B")
SIZES = {"10 kB": 10_000, "1 MB": 1_000_000, "20 MB": 20_000_000}
MOST_ROUNDS, BUDGET_S = 50, 4.0  # of each size, both stores


def main() -> int:
    with tempfile.TemporaryDirectory() as folder, bucket() as s3:
        stores = {"folder": FolderBlobStore(Path(folder)), "S3": s3}
        print(f"{'':8}{'':6}{'folder':>12}{'S3':>12}{'S3 / folder':>14}   medians, ms")
        measured = [compare(stores, label, size) for label, size in SIZES.items()]
    return 0 if all(measured) else 1


def compare(stores: dict[str, BlobStore], label: str, size: int) -> bool:
    """Print a size's two lines; whether there was time for one round at least."""
    took: dict[tuple[str, str], list[float]] = {}
    until = time.perf_counter() + BUDGET_S
    rounds = 0
    while rounds < MOST_ROUNDS and time.perf_counter() < until:
        data = os.urandom(size)
        for name, store in stores.items():
            put_s, sha256 = timed(store.put, data)
            get_s, got = timed(store.get, sha256)
            assert got == data, (name, label)
            store.discard(sha256)
            took.setdefault(("put", name), []).append(put_s)
            took.setdefault(("get", name), []).append(get_s)
        rounds += 1
    for verb in ("put", "get"):
        ms = {name: 1e3 * median(took[verb, name]) for name in stores}
        print(f"{label:8}{verb:6}{ms['folder']:12.2f}{ms['S3']:12.2f}{ms['S3'] / ms['folder']:14.1f}   {rounds} rounds")
    return rounds > 0


def timed(work: Callable[[A], B], on: A) -> tuple[float, B]:
    begun = time.perf_counter()
    made = work(on)
    return time.perf_counter() - begun, made


@contextmanager
def bucket() -> Iterator[BlobStore]:
    if os.environ.get("ISODYN_BLOB_URL", "").startswith("s3://"):
        yield open_blob_store(os.environ["ISODYN_BLOB_URL"])
        return
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    keys = {"AWS_ACCESS_KEY_ID": "benchmark", "AWS_SECRET_ACCESS_KEY": "benchmark", "AWS_REGION": "us-east-1"}
    os.environ.update(keys, AWS_ENDPOINT_URL=f"http://127.0.0.1:{port}")
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        make_bucket(port, server)
        yield open_blob_store("s3://benchmark")
    finally:
        server.terminate()
        server.wait()


def make_bucket(port: int, server: "subprocess.Popen[bytes]") -> None:
    scope = {"Authorization": "AWS4-HMAC-SHA256 Credential=benchmark/20260101/us-east-1/s3/aws4_request"}
    while server.poll() is None:
        with suppress(OSError):
            connection = HTTPConnection("127.0.0.1", port, timeout=5)
            connection.request("PUT", "/benchmark", headers=scope)
            connection.getresponse().read()
            connection.close()
            return
        time.sleep(0.05)
    raise SystemExit("no server of the S3 API: pip install 'moto[server,s3]', or set ISODYN_BLOB_URL")


if __name__ == "__main__":
    sys.exit(main())
