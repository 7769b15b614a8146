"""Many devices followed at once: how far behind does the server fall?

`python benchmarks/concurrent_tracks.py [tracks] [seconds]` starts `isodyn serve` on a hall of 30 m by 20 m whose field
is known, and streams a step every tenth of a second over one WebSocket a track, from one client process on the same
machine. The lag of a step is from when it was due until the answer that it is stored has come. Then what a step costs
without a server.
"""

import asyncio
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np
from websockets.asyncio.client import connect

from app.blobs import open_blob_store
from app.db.engine import create_database_engine, session_factory
from app.db.tables import Building, Floor, Map, Organisation
from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.positioning.locate import prepare_floor
from app.services.artefacts import grid_to_bytes
from app.services.track_spec import StepKind
from app.services.track_steps import core_step
from app.settings import Settings
from app.tracking.options import TrackOptions
from app.tracking.track import begin, follow, make_tracker

KEY = "isd_benchmark"
WIDTH_M, DEPTH_M = 30.0, 20.0
PARTICLES, RATE_HZ, SPEED_M_S = 2000, 10.0, 1.0


def field_ut(x, y):
    """(..., 3) smooth, and nowhere alike."""
    return np.stack([
        18 + 6 * np.sin(0.9 * x + 0.3) * np.cos(0.7 * y) + 3 * np.sin(0.23 * x * y / 10),
        3 + 5 * np.cos(0.6 * x - 0.8 * y) + 3 * np.sin(0.31 * y + 0.05 * x * x / 10),
        -42 + 6 * np.sin(0.5 * x + 1.1 * y),
    ], axis=-1)  # fmt: skip


def hall() -> FieldGrid:
    x, y = np.meshgrid(np.arange(-3.0, WIDTH_M + 3.01, 0.25), np.arange(-3.0, DEPTH_M + 3.01, 0.25))
    mean = field_ut(x, y)[None]
    gradient = np.stack([np.gradient(mean, 0.25, axis=2), np.gradient(mean, 0.25, axis=1)], axis=-1)
    return FieldGrid(
        "vector", (-3.0, -3.0), 0.25, np.array([1.2]), mean.astype(np.float32), np.full(mean.shape, 0.3, np.float32),
        gradient.astype(np.float32), np.ones(mean.shape[:3], dtype=np.bool_), np.array([18.0, 3.0, -42.0]),
        np.full(3, 5.0), np.full(3, 0.4), 0.0, ErrorStructure(0.0, 0.0, 1.0, 1.0),
    )  # fmt: skip


def walk(seed: int, count: int) -> list[dict[str, object]]:
    """Steps of a device that walks from place to place, in the level frame of its first step."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform([1.0, 1.0], [WIDTH_M - 1.0, DEPTH_M - 1.0], (200, 2))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = SPEED_M_S / RATE_HZ * np.arange(count)
    p = np.stack([np.interp(at, along, corners[:, k]) for k in (0, 1)], axis=1)
    B = field_ut(p[:, 0], p[:, 1]) + rng.normal(0.0, 0.3, (count, 3))
    turn = rng.uniform(-np.pi, np.pi)
    back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    moved, flat = (p - p[0]) @ back, B[:, :2] @ back
    return [
        {"number": k, "t_s": k / RATE_HZ, "b_ut": [*flat[k].tolist(), float(B[k, 2])],
         "displacement_m": [*moved[k].tolist(), 0.0], "yaw_rad": 0.0}
        for k in range(count)
    ]  # fmt: skip


def start_server(folder: Path) -> tuple[subprocess.Popen[bytes], int]:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {**os.environ, "ISODYN_DATA_DIR": str(folder), "ISODYN_ADMIN_KEY": KEY, "ISODYN_PORT": str(port),
                   "ISODYN_MAX_TRACKS_PER_KEY": "10000"}  # fmt: skip
    process = subprocess.Popen([sys.executable, "-m", "app.cli", "serve", "--no-worker"], env=environment)
    deadline = time.monotonic() + 180
    while time.monotonic() < deadline:
        try:
            if httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200:
                return process, port
        except httpx.TransportError:
            time.sleep(0.1)
    raise SystemExit("the server did not start")


def put_hall(folder: Path) -> str:
    settings = Settings(data_dir=folder, database_url=None, blob_url=None)
    engine = create_database_engine(settings.resolved_database_url)
    blobs = open_blob_store(settings.resolved_blob_url)
    with session_factory(engine).begin() as session:
        owner = session.query(Organisation).filter_by(name="default").one().id
        building = Building(organisation_id=owner, name="Hall")
        session.add(building)
        session.flush()
        floor = Floor(organisation_id=owner, building_id=building.id, name="G", ordinal=0, elevation_m=0.0)
        session.add(floor)
        session.flush()
        made = Map(organisation_id=owner, floor_id=floor.id, status="ready", spec={}, survey_ids=[],
                   components="vector", grid_sha256=blobs.put(grid_to_bytes(hall())))  # fmt: skip
        session.add(made)
        session.flush()
        floor.active_map_id = made.id
    engine.dispose()
    return str(building.id)


async def device(url: str, steps: list[dict[str, object]], start: float, lags_s: list[tuple[float, float]]) -> str:
    """Send each step when it is due; (when it was due, its lag) of each. Returns the last state."""
    headers = {"Authorization": f"Bearer {KEY}"}
    async with connect(url, additional_headers=headers, proxy=None, compression=None, open_timeout=60) as stream:
        await stream.recv()

        async def send() -> None:
            for k, step in enumerate(steps):
                await asyncio.sleep(max(start + k / RATE_HZ - time.monotonic(), 0.0))
                await stream.send(json.dumps({"type": "step", **step}))

        sending = asyncio.create_task(send())
        done, state = 0, ""
        while done < len(steps):
            told = json.loads(await stream.recv())
            now = time.monotonic()
            lags_s += [(k / RATE_HZ, now - start - k / RATE_HZ) for k in range(done, told["next_step"])]
            done, state = told["next_step"], told["estimate"]["state"]
        await sending
        return state


async def stream_all(port: int, tracks: list[str], seconds: float) -> tuple[list[tuple[float, float]], list[str]]:
    lags_s: list[tuple[float, float]] = []
    count = int(seconds * RATE_HZ)
    walks = [walk(seed, count) for seed in range(len(tracks))]
    start = time.monotonic() + 3.0
    phase = np.random.default_rng(0).uniform(0.0, 5.0, len(tracks))  # devices do not start all at once
    states = await asyncio.gather(*(
        device(f"ws://127.0.0.1:{port}/v1/tracks/{track}/stream", steps, start + late, lags_s)
        for track, steps, late in zip(tracks, walks, phase, strict=True)
    ))  # fmt: skip
    return lags_s, list(states)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def served(tracks: int, seconds: float) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        process, port = start_server(folder)
        try:
            building = put_hall(folder)
            client = httpx.Client(base_url=f"http://127.0.0.1:{port}", headers={"Authorization": f"Bearer {KEY}"},
                                  timeout=120)  # fmt: skip
            body = {"building_id": building, "frame": "level",
                    "options": {"particles": PARTICLES, "least_particles": PARTICLES}}  # fmt: skip
            ids = [client.post("/v1/tracks", json={**body, "seed": seed}).json()["id"] for seed in range(tracks)]
            for k, step in enumerate(walk(10_000, 60)):  # compiled code is loaded by now
                if k == 0:
                    warm = client.post("/v1/tracks", json=body).json()["id"]
                client.post(f"/v1/tracks/{warm}/steps", json={"steps": [step]}).raise_for_status()
            begun, cpu = time.monotonic(), cpu_s(process.pid)
            lags_s, states = asyncio.run(stream_all(port, ids, seconds))
            took_s, used_s = time.monotonic() - begun, cpu_s(process.pid) - cpu
            told_s = np.array(lags_s)
            thirds = [told_s[(told_s[:, 0] >= a * seconds / 3) & (told_s[:, 0] < (a + 1) * seconds / 3), 1]
                      for a in range(3)]  # fmt: skip
            print(f"{tracks} tracks of {RATE_HZ:g} steps a second, {PARTICLES} particles each, for {seconds:g} s")
            for label, lag in zip(("first", "second", "last"), thirds, strict=True):
                p50, p95, p99 = 1e3 * np.percentile(lag, [50, 95, 99])
                print(f"  {label} third: lag {p50:,.0f} ms median, {p95:,.0f} ms 95 %, {p99:,.0f} ms 99 %, "
                      f"{1e3 * lag.max():,.0f} ms at most")  # fmt: skip
            print(f"  server: {used_s / took_s:.2f} cores; client: {time.process_time() / took_s:.2f} cores")
            print(f"  converged at the end: {states.count('converged')} of {tracks}")
        finally:
            process.terminate()
            process.wait(timeout=30)


def in_process(count: int = 300) -> None:
    options = TrackOptions(particles=PARTICLES, least_particles=PARTICLES)
    tracker = make_tracker([prepare_floor("hall", hall())], "level", options, 0)
    spent: dict[str, list[float]] = {"no reading": [], "reading": [], "search": []}
    for seed in (0, 1):
        state = begin()
        for raw in walk(seed, count):
            step = core_step(raw, StepKind("level"))
            before = state
            start = time.perf_counter()
            state = follow(tracker, state, step).state
            took = time.perf_counter() - start
            kind = "search" if state.searched_m != before.searched_m else (
                "reading" if state.recent is not before.recent else "no reading")  # fmt: skip
            if seed:  # the first compiles
                spent[kind].append(took)
    print("follow in process: " + ", ".join(
        f"{kind} {1e3 * np.mean(took):.2f} ms ({len(took)})" for kind, took in spent.items() if took
    ))  # fmt: skip


if __name__ == "__main__":
    served(int(sys.argv[1]) if len(sys.argv) > 1 else 100, float(sys.argv[2]) if len(sys.argv) > 2 else 30.0)
    in_process()
