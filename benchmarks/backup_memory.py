"""What a backup and a restore cost in memory and time: memory must not grow with the installation.

Run: python benchmarks/backup_memory.py. Two installations on SQLite in a temporary folder, the second ten times the
first, with blobs of 1 MiB and batches of steps as rows; each command is a process of its own.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from app.blobs import FolderBlobStore
from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Building, Calibration, Key, Organisation, Track, TrackSteps, utc_now

SMALL = (50, 10_000)
TIMES = 10
GROWTH_TARGET_MIB = 32
MEASURED = """
import sys, time
from pathlib import Path
from app.blobs import FolderBlobStore
from app.db.engine import create_database_engine
from app.services.make_backup import make_backup
from app.services.restore_backup import restore_backup
verb, url, blobs, path = sys.argv[1:]
start, quiet = time.perf_counter(), lambda *_: None
if verb == "backup":
    make_backup(create_database_engine(url), FolderBlobStore(Path(blobs)), Path(path), quiet)
else:
    restore_backup(url, FolderBlobStore(Path(blobs)), Path(path), quiet)
took_s = time.perf_counter() - start
peak = Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]  # rusage's would begin at the parent's
print(took_s, int(peak) / 1024)
"""


def fill(url: str, blobs: FolderBlobStore, count: int, rows: int) -> None:
    migrate(url)
    engine = create_database_engine(url)
    with session_factory(engine).begin() as session:
        session.add(Organisation(id="o", name="o"))
        session.flush()
        session.add_all([Key(id="k", organisation_id="o", name="k", sha256="0" * 64, scopes=[]),
                         Building(id="b", organisation_id="o", name="b")])  # fmt: skip
        session.flush()
        session.add(Track(id="t", organisation_id="o", key_id="k", building_id="b", frame="level", seed=0,
                          spec={"maps": []}))  # fmt: skip
        session.flush()
        for number in range(count):
            session.add(Calibration(
                organisation_id="o", device="d", version=number, method="m", model={}, fit={}, reference={},
                samples_sha256=blobs.put(os.urandom(2**20)), measured_at=utc_now(),
            ))  # fmt: skip
        for number in range(rows):
            session.add(TrackSteps(track_id="t", sequence=number, next_step=number, data=os.urandom(400), settled=None,
                                   sha256="0" * 64))  # fmt: skip
    engine.dispose()


def measure(verb: str, url: str, blobs: Path, archive: Path) -> tuple[float, float]:
    """Seconds and peak resident MiB."""
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, verb, url, str(blobs), str(archive)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    seconds, mib = map(float, done.stdout.split())
    return seconds, mib


def main() -> None:
    peaks: dict[str, list[float]] = {"backup": [], "restore": []}
    with tempfile.TemporaryDirectory() as name:
        for times in (1, TIMES):
            count, rows = (times * each for each in SMALL)
            folder = Path(name) / str(times)
            url, blobs, archive = f"sqlite:///{folder / 'isodyn.db'}", folder / "blobs", folder / "backup.zip"
            fill(url, FolderBlobStore(blobs), count, rows)
            for verb in peaks:
                new = f"sqlite:///{folder / 'new' / 'isodyn.db'}", folder / "new" / "blobs"
                seconds, mib = measure(verb, *((url, blobs) if verb == "backup" else new), archive)
                peaks[verb].append(mib)
                print(f"{verb:8} {count:5} blobs of 1 MiB, {rows:7,} rows: {seconds:6.2f} s, peak {mib:6.1f} MiB")
    for verb, (small, large) in peaks.items():
        met = "met" if large - small < GROWTH_TARGET_MIB else "MISSED"
        print(f"{verb:8} grows by {large - small:.1f} MiB, target < {GROWTH_TARGET_MIB} MiB: {met}")


if __name__ == "__main__":
    main()
