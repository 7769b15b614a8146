"""What HTTP adds to `locate`: the same window answered in process and over HTTP, one after the other, in one run.

Target: under 5 ms median on top of the in-process call. Also prints how long `isodyn serve` takes until `/readyz`
(target: under 3 s). Exits non-zero when a target is missed.
"""

import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import httpx
import numpy as np
from sqlalchemy import select
from threadpoolctl import threadpool_limits

from app.db.tables import Organisation
from app.geometry import yaw_matrix
from app.main import open_context
from app.positioning.fix import LocateOptions
from app.positioning.window import Window
from app.services.locate_window import active_maps, locate_window
from app.services.reach import Reach
from app.settings import Settings

KEY = "isd_benchmark"
ROUNDS = 200


def field_uT(p: np.ndarray) -> np.ndarray:
    """A smooth, non-repeating field: sums of waves of unrelated lengths."""
    rng = np.random.default_rng(3)
    k, phase, way = rng.normal(0, 0.8, (40, 2)), rng.uniform(0, 6.28, 40), rng.normal(0, 1.0, (40, 3))
    return np.array([18.0, 3.0, -42.0]) + np.cos(p @ k.T + phase) @ way


def survey_csv(seed: int) -> bytes:
    rng = np.random.default_rng(seed)
    xs, lanes = np.arange(0, 20, 0.25), np.arange(0.3 * seed, 15, 1.0)
    x = np.concatenate([xs if k % 2 == 0 else xs[::-1] for k in range(len(lanes))])
    p = np.column_stack([x, np.repeat(lanes, len(xs))])
    B = field_uT(p) + rng.normal(0, 0.4, (len(p), 3))
    rows = np.column_stack([0.2 * np.arange(len(p)), p, np.full(len(p), 1.2), B])
    text = "\n".join(",".join(f"{v:.4f}" for v in row) for row in rows)
    return f"t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n{text}\n".encode()


def main() -> int:
    with tempfile.TemporaryDirectory() as folder:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        environment = {**os.environ, "ISODYN_DATA_DIR": folder, "ISODYN_ADMIN_KEY": KEY, "ISODYN_PORT": str(port)}
        ready_s, server = [], None
        for _ in range(3):  # the last one stays up
            if server is not None:
                server.terminate()
                server.wait()
            start = time.perf_counter()
            server = subprocess.Popen([sys.executable, "-m", "app.cli", "serve"], env=environment)
            ready_s.append(wait_until_ready(port, start))
        try:
            return compare(port, Path(folder), ready_s)
        finally:
            assert server is not None
            server.terminate()
            server.wait()


def wait_until_ready(port: int, start: float) -> float:
    while time.perf_counter() - start < 60:
        try:
            if httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200:
                return time.perf_counter() - start
        except httpx.TransportError:
            time.sleep(0.02)
    raise SystemExit("the server did not become ready")


def compare(port: int, folder: Path, ready_s: list[float]) -> int:
    http = httpx.Client(base_url=f"http://127.0.0.1:{port}", headers={"Authorization": f"Bearer {KEY}"}, timeout=120)
    building = http.post("/v1/buildings", json={"name": "B"}).json()["id"]
    floor = http.post(f"/v1/buildings/{building}/floors", json={"name": "F", "ordinal": 0}).json()["id"]
    for seed in range(3):
        job = http.post(f"/v1/floors/{floor}/surveys", content=survey_csv(seed)).json()["job"]
    while http.get(f"/v1/jobs/{job['id']}").json()["status"] in ("accepted", "running"):
        time.sleep(0.2)

    heading = 0.5
    walked = np.column_stack([np.linspace(0, 8, 20), np.zeros((20, 2))])
    p = np.array([4.0, 4.0]) + (walked @ yaw_matrix(heading).T)[:, :2]
    B = (field_uT(p) + np.random.default_rng(9).normal(0, 0.4, (20, 3))) @ yaw_matrix(heading)
    window = Window("level", B, walked, 0.4)
    body = {"window": {"frame": "level", "b_ut": B.tolist(), "displacement_m": walked.tolist(), "noise_ut": 0.4}}

    settings = Settings(data_dir=folder)
    context = open_context(settings)
    with context.engine.connect() as connection:
        organisation = connection.scalars(select(Organisation.id).where(Organisation.name == "default")).one()
        maps = active_maps(connection, Reach(organisation), floor_ids=[floor])

    def in_process() -> object:
        return locate_window(maps, context.grids, window, composition="raw", techniques=("ml", "mlr", "abl"),
                             prior=None, options=LocateOptions())  # fmt: skip

    def over_http() -> object:
        answer = http.post(f"/v1/floors/{floor}/locate", json=body)
        assert answer.status_code == 200, answer.text
        return answer

    for _ in range(10):
        in_process(), over_http()
    inside, outside = [], []
    for _ in range(ROUNDS):
        inside.append(timed(in_process))
        outside.append(timed(over_http))
    overhead = statistics.median(outside) - statistics.median(inside)
    print(f"in process  median {statistics.median(inside):6.2f} ms")
    print(f"over HTTP   median {statistics.median(outside):6.2f} ms")
    print(f"overhead    median {overhead:6.2f} ms   target < 5     {'PASS' if overhead < 5 else 'FAIL'}")
    ready = statistics.median(ready_s)
    print(f"ready after median {ready:6.2f} s    target < 3     {'PASS' if ready < 3 else 'FAIL'}")
    return 0 if overhead < 5 and ready < 3 else 1


def timed(call: object) -> float:
    start = time.perf_counter()
    call()  # type: ignore[operator]
    return 1e3 * (time.perf_counter() - start)


if __name__ == "__main__":
    with threadpool_limits(1):  # as the server does
        sys.exit(main())
