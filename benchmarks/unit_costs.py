"""What one upload, build, fix and track step costs, and what many of them would need by arithmetic.

A real `isodyn serve --no-worker` and a real `isodyn worker` on this machine; a floor of 60 m by 40 m, surveyed by walks
of half an hour (9,600 samples). Seconds are of processor time, of each process with the children it has ended, from
/proc; bytes are those of the blob folder and of the database. Costs of processor time depend on the machine: what is
printed at the end is what docs/capacity.md says, with this machine's figures. Linux only.
"""

import argparse
import json
import os
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from http_overhead import KEY, field_uT
from locate_throughput import DEPTH_M, WIDTH_M, questions, server, survey_csv

SURVEYS, LATER, FIXES, STEPS = 4, 3, 300, 600
STEP_BATCH = 10
FLOORS_OF_A_BUILDING = 5
BUILDINGS, FLOORS, FIXES_PER_S, SURVEYS_A_YEAR = 10**5, 10**6, 10**4, 4
FILLED = 0.6  # of a core that answers quickly
YEAR_S = 365.25 * 86400


def family_cpu_s(pid: int) -> float:
    """Processor time of a process, of its children that have ended and of those that live."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    taken = sum(int(fields[k]) for k in (11, 12, 13, 14)) / os.sysconf("SC_CLK_TCK")
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        with suppress(FileNotFoundError):
            taken += family_cpu_s(int(child))
    for thread in Path(f"/proc/{pid}/task").iterdir():
        if thread.name != str(pid):
            for child in (thread / "children").read_text().split():
                with suppress(FileNotFoundError):
                    taken += family_cpu_s(int(child))
    return taken


@contextmanager
def worker(folder: Path) -> Iterator[int]:
    environment = {**os.environ, "ISODYN_DATA_DIR": str(folder)}
    process = subprocess.Popen([sys.executable, "-m", "app.cli", "worker"], env=environment)
    try:
        yield process.pid
    finally:
        process.terminate()
        process.wait()


def folder_bytes(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def database_bytes(file: Path) -> int:
    """Of a copy without free pages: neither the log nor what was deleted counts."""
    with closing(sqlite3.connect(file)) as connection, tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy.db"
        connection.execute("VACUUM INTO ?", (str(copy),))
        return copy.stat().st_size


class Meter:
    """Processor time of the server and the worker between two looks."""

    def __init__(self, server_pid: int, worker_pid: int, folder: Path) -> None:
        self._pids, self._folder = (server_pid, worker_pid), folder
        self.look()

    def look(self) -> tuple[float, float, int, int]:
        """Since the last look: seconds of the server and of the worker, bytes of blobs and of the database."""
        now = (*(family_cpu_s(pid) for pid in self._pids), folder_bytes(self._folder / "blobs"),
               database_bytes(self._folder / "isodyn.db"))  # fmt: skip
        before, self._before = getattr(self, "_before", now), now
        return tuple(b - a for a, b in zip(before, now, strict=True))  # type: ignore[return-value]


def wait_for(http: httpx.Client, job_id: str) -> None:
    while (job := http.get(f"/v1/jobs/{job_id}").json())["status"] in ("accepted", "running"):
        time.sleep(0.5)
    assert job["status"] == "successful", job


def track_steps(count: int) -> list[dict[str, Any]]:
    """A device carried along a line to and fro, ten steps a second."""
    rng = np.random.default_rng(3)
    x = 5.0 + np.abs((0.1 * np.arange(count)) % 80.0 - 40.0)
    p = np.column_stack([x, np.full(count, 20.0)])
    B = field_uT(p) + rng.normal(0, 0.4, (count, 3))
    moved = np.column_stack([p - p[0], np.zeros(count)])
    return [
        {"number": k, "t_s": 0.1 * k, "b_ut": B[k].tolist(), "displacement_m": moved[k].tolist()} for k in range(count)
    ]


def measure(http: httpx.Client, meter: Meter) -> dict[str, float]:
    building = http.post("/v1/buildings", json={"name": "B"}).json()["id"]
    body = {"name": "F", "ordinal": 0, "elevation_m": 0.0, "auto_build": False}
    floor = http.post(f"/v1/buildings/{building}/floors", json=body).json()["id"]
    walks = [survey_csv(seed) for seed in range(SURVEYS + LATER)]

    def upload(walk: bytes) -> Any:
        answer = http.post(f"/v1/floors/{floor}/surveys", content=walk)
        answer.raise_for_status()
        return answer.json()

    upload(walks[0])
    meter.look()
    for walk in walks[1:SURVEYS]:
        upload(walk)
    told = meter.look()
    costs = {"upload_s": told[0] / (SURVEYS - 1), "survey_bytes": told[2] / (SURVEYS - 1)}
    job = http.post(f"/v1/floors/{floor}/maps", json={}).json()["job"]["id"]
    wait_for(http, job)
    told = meter.look()
    costs |= {"build_s": told[1], "map_bytes": told[2]}
    http.patch(f"/v1/floors/{floor}", json={"auto_build": True}).raise_for_status()
    for walk in walks[SURVEYS:]:
        wait_for(http, upload(walk)["job"]["id"])
    told = meter.look()
    costs |= {"rebuild_s": told[1] / LATER, "survey_row_bytes": told[3] / LATER}
    asked = [question.body for question in questions()]
    headers = {"Content-Type": "application/json"}

    def fix(k: int) -> None:
        http.post(f"/v1/floors/{floor}/locate", content=asked[k % len(asked)], headers=headers).raise_for_status()

    for k in range(50):
        fix(k)
    meter.look()
    for k in range(FIXES):
        fix(k)
    costs["fix_s"] = meter.look()[0] / FIXES
    track = http.post("/v1/tracks", json={"floor_ids": [floor], "frame": "building"}).json()["id"]
    steps = track_steps(STEPS + 200)
    for start in range(0, len(steps), STEP_BATCH):
        if start == 200:
            meter.look()
        http.post(f"/v1/tracks/{track}/steps", json={"steps": steps[start : start + STEP_BATCH]}).raise_for_status()
    told = meter.look()
    costs |= {"step_s": told[0] / STEPS, "step_bytes": told[3] / STEPS}
    assert http.get(f"/v1/tracks/{track}").json()["estimate"]["state"] == "converged"
    return costs


def main() -> int:
    argparse.ArgumentParser(description=__doc__.split("\n")[0]).parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with server(folder) as (server_pid, port), worker(folder) as worker_pid:
            headers = {"Authorization": f"Bearer {KEY}"}
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=headers, timeout=120) as http:
                time.sleep(8.0)  # warming up is not part of it
                costs = measure(http, Meter(server_pid, worker_pid, folder))
    print(f"measured on this machine; a floor of {WIDTH_M:.0f} m by {DEPTH_M:.0f} m")
    for name, value in costs.items():
        print(f"  {name:18} {value:,.4f}" if name.endswith("_s") else f"  {name:18} {value:,.0f}")
    cores = FIXES_PER_S * costs["fix_s"] / FILLED
    tracked = FIXES_PER_S * costs["step_s"] / FILLED
    first = FLOORS * (SURVEYS * costs["upload_s"] + costs["build_s"])
    steady = FLOORS * SURVEYS_A_YEAR * (costs["upload_s"] + costs["rebuild_s"]) / YEAR_S
    stored = FLOORS * (2 * SURVEYS_A_YEAR * costs["survey_bytes"] + costs["map_bytes"])
    print(f"by arithmetic: {BUILDINGS:,} buildings, {FLOORS:,} floors, {FIXES_PER_S:,} fixes a second")
    print(f"  cores that answer windows on one floor, filled to {FILLED:.0%}: {cores:,.0f}")
    print(f"  the same as steps of tracks: {tracked:,.0f}")
    print(f"  to survey and map everything once: {first / 86400:,.0f} days of one core")
    print(f"  {SURVEYS_A_YEAR} surveys a floor and year afterwards: {steady:,.2f} cores")
    print(f"  blobs after two years: {stored / 1e12:,.1f} TB")
    print(json.dumps(costs))
    return 0


if __name__ == "__main__":
    sys.exit(main())
