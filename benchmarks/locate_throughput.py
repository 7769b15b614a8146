"""How much of the search's speed is left over HTTP: `POST /v1/floors/{id}/locate`, one floor, a prior of 5 m.

In one run, in turns: the kernel (`app.positioning.locate.locate` in a loop, one thread, the floor in memory), and the
same windows sent to a real `isodyn serve --no-worker` by 1 client, by 16 clients, and by 16 clients with the server
held on one core. The clients are one more process, with plain sockets. They take processor time too, which is why the
shares are per core, not per machine:

- on one core: answers per second of a server that has one core while the clients have the others, against kernel calls
  per second of one thread;
- per processor second: answers per second of processor time the server took (/proc/PID/stat, all its threads; 16
  clients, all cores), against kernel calls per second of processor time.

Targets: both at least 60 %; p99 at most 5 times p50 with 16 clients; less than 5 ms median on top of the kernel with 1
client. Exits non-zero when one is missed. Linux only.
"""

import argparse
import asyncio
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from http_overhead import KEY, field_uT, wait_until_ready
from sqlalchemy import select
from threadpoolctl import threadpool_limits

from app.api.context import Context
from app.db.tables import Floor, Job
from app.geometry import yaw_matrix
from app.main import open_context
from app.positioning.fix import Prior
from app.positioning.locate import SearchableFloor, locate
from app.positioning.window import Window
from app.services.build_map import claim_build, fit_build, publish_build
from app.services.locate_window import active_maps
from app.services.reach import Reach
from app.settings import Settings

WIDTH_M, DEPTH_M = 60.0, 40.0
SAMPLES, WALKED_M, NOISE_UT = 20, 8.0, 0.4
PRIOR_SD_M = 5.0
QUESTIONS = 32
ROUNDS, TURN_S = 5, 3.0
LEAST_SHARE, MOST_TAIL, MOST_OVERHEAD_MS = 0.60, 5.0, 5.0


@dataclass(frozen=True)
class Question:
    """The same question for the kernel and as a request."""

    window: Window
    prior: Prior
    body: str


@dataclass
class Tally:
    """What one way of asking came to, over all its turns."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    latency_ms: list[float] = field(default_factory=list)

    def add(self, wall_s: float, cpu_s: float, latency_ms: Sequence[float]) -> None:
        self.wall_s, self.cpu_s = self.wall_s + wall_s, self.cpu_s + cpu_s
        self.latency_ms.extend(latency_ms)

    @property
    def per_s(self) -> float:
        return len(self.latency_ms) / self.wall_s

    @property
    def per_cpu_s(self) -> float:
        return len(self.latency_ms) / self.cpu_s

    def quantile_ms(self, share: float) -> float:
        return float(np.quantile(self.latency_ms, share))


def survey_csv(seed: int) -> bytes:
    """A lawn-mower walk over the whole floor, lanes 1 m apart."""
    rng = np.random.default_rng(seed)
    xs, lanes = np.arange(0, WIDTH_M, 0.25), np.arange(0.4 * seed, DEPTH_M, 1.0)
    x = np.concatenate([xs if k % 2 == 0 else xs[::-1] for k in range(len(lanes))])
    p = np.column_stack([x, np.repeat(lanes, len(xs))])
    B = field_uT(p) + rng.normal(0, NOISE_UT, (len(p), 3))
    rows = np.column_stack([0.2 * np.arange(len(p)), p, np.full(len(p), 1.2), B])
    text = "\n".join(",".join(f"{v:.4f}" for v in row) for row in rows)
    return f"t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n{text}\n".encode()


def questions() -> list[Question]:
    """Straight walks in any direction, heading unknown, each with a prior that is off by a draw of its own sd."""
    rng = np.random.default_rng(5)
    asked = []
    for _ in range(QUESTIONS):
        turn = yaw_matrix(rng.uniform(-np.pi, np.pi))
        walked = np.column_stack([np.linspace(0, WALKED_M, SAMPLES), np.zeros((SAMPLES, 2))])
        p = rng.uniform([10, 10], [WIDTH_M - 10, DEPTH_M - 10]) + (walked @ turn.T)[:, :2]
        B = (field_uT(p) + rng.normal(0, NOISE_UT, (SAMPLES, 3))) @ turn
        x, y = p[-1] + rng.normal(0, PRIOR_SD_M, 2)
        window = {"frame": "level", "b_ut": B.tolist(), "displacement_m": walked.tolist(), "noise_ut": NOISE_UT}
        body = {"window": window, "prior": {"position_m": [x, y, 1.2], "sd_m": PRIOR_SD_M}}
        prior = Prior((float(x), float(y), 1.2), PRIOR_SD_M)
        asked.append(Question(Window("level", B, walked, NOISE_UT), prior, json.dumps(body)))
    return asked


def build_waiting_maps(context: Context) -> None:
    """What a worker does with every waiting job."""
    while True:
        with context.transaction() as session:
            job_id = session.scalars(select(Job.id).where(Job.status == "accepted").order_by(Job.id)).first()
            if job_id is None:
                return
            plan = claim_build(session, job_id)
        result = fit_build(plan, context.blobs, lambda _fraction, _message: None)
        with context.transaction() as session:
            publish_build(session, job_id, plan, result)


def ask_kernel(
    floors: Sequence[SearchableFloor], asked: Sequence[Question], turn_s: float
) -> tuple[float, float, list[float]]:
    """Wall and processor seconds, and the milliseconds of each call."""
    took_ms: list[float] = []
    start, cpu_start = time.perf_counter(), time.process_time()
    while time.perf_counter() - start < turn_s:
        for question in asked:
            before = time.perf_counter()
            locate(question.window, floors, prior=question.prior)
            took_ms.append(1e3 * (time.perf_counter() - before))
    return time.perf_counter() - start, time.process_time() - cpu_start, took_ms


class Clients:
    """Clients in a process of their own, which waits for turns."""

    def __init__(self, port: int, path: str, asked: Sequence[Question]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--clients"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._ask({"port": port, "path": path, "bodies": [question.body for question in asked]})

    def turn(self, clients: int) -> tuple[float, list[float]]:
        """Wall seconds, and the milliseconds of each answer."""
        wall_s, took_ms = self._ask({"clients": clients, "turn_s": TURN_S})
        return wall_s, took_ms

    def _ask(self, order: dict[str, object]) -> list[Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(order), file=self._process.stdin, flush=True)
        answer: list[Any] = json.loads(self._process.stdout.readline())
        return answer

    def close(self) -> None:
        self._process.communicate()


def be_clients() -> None:
    """The other side of `Clients`: one order per line, one answer per line."""
    where = json.loads(sys.stdin.readline())
    head = (
        f"POST {where['path']} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {KEY}\r\n"
        "Content-Type: application/json\r\n"
    )
    requests = [f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode() for body in where["bodies"]]
    print("[]", flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        start = time.perf_counter()
        took_ms = asyncio.run(_all_clients(where["port"], requests, order["clients"], start + order["turn_s"]))
        print(json.dumps([time.perf_counter() - start, took_ms]), flush=True)


async def _all_clients(port: int, requests: Sequence[bytes], clients: int, until: float) -> list[float]:
    """Each client sends its next window as soon as it has the answer to the last."""
    took_ms: list[float] = []

    async def client(number: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        at = number * len(requests) // clients
        while time.perf_counter() < until:
            before = time.perf_counter()
            writer.write(requests[at % len(requests)])
            answer = await reader.readuntil(b"\r\n\r\n")
            assert answer.startswith(b"HTTP/1.1 200"), answer
            length = next(line for line in answer.lower().split(b"\r\n") if line.startswith(b"content-length:"))
            await reader.readexactly(int(length.split(b":")[1]))
            took_ms.append(1e3 * (time.perf_counter() - before))
            at += 1
        writer.close()

    await asyncio.gather(*(client(number) for number in range(clients)))
    return took_ms


def cpu_s_of(pid: int) -> float:
    """Processor time that a process has taken, user and system, all threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def hold_on(pid: int, cores: set[int]) -> None:
    """Every thread of a process on these cores only; threads still to come inherit it."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        with suppress(ProcessLookupError):  # a thread may end in between
            os.sched_setaffinity(int(task.name), cores)


@contextmanager
def server(folder: Path) -> Iterator[tuple[int, int]]:
    """A server process on loopback: (its id, its port)."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {**os.environ, "ISODYN_DATA_DIR": str(folder), "ISODYN_ADMIN_KEY": KEY, "ISODYN_PORT": str(port)}
    start = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "app.cli", "serve", "--no-worker"], env=environment)
    try:
        wait_until_ready(port, start)
        yield process.pid, port
    finally:
        process.terminate()
        process.wait()


def make_floor(port: int, context: Context) -> str:
    """A floor with an active map."""
    with httpx.Client(
        base_url=f"http://127.0.0.1:{port}", headers={"Authorization": f"Bearer {KEY}"}, timeout=120
    ) as http:
        building = http.post("/v1/buildings", json={"name": "B"}).json()["id"]
        floor = str(http.post(f"/v1/buildings/{building}/floors", json={"name": "F", "ordinal": 0}).json()["id"])
        for seed in range(2):
            http.post(f"/v1/floors/{floor}/surveys", content=survey_csv(seed)).raise_for_status()
    build_waiting_maps(context)
    return floor


def prepared(context: Context, floor: str) -> list[SearchableFloor]:
    with context.engine.connect() as connection:
        organisation = connection.scalars(select(Floor.organisation_id).where(Floor.id == floor)).one()
        maps = active_maps(connection, Reach(organisation), floor_ids=[floor])
    return context.grids.searchable([(each.floor_id, each.grid_sha256) for each in maps])


def check_equal(port: int, path: str, floors: Sequence[SearchableFloor], asked: Sequence[Question]) -> None:
    """Both sides must do the same work; it also warms both up."""
    headers = {"Authorization": f"Bearer {KEY}", "Content-Type": "application/json"}
    for question in asked:
        answer = httpx.post(f"http://127.0.0.1:{port}{path}", content=question.body, headers=headers, timeout=120)
        fix = locate(question.window, floors, prior=question.prior)
        assert fix.posterior is not None
        assert answer.json()["posterior"]["position_m"] == list(fix.posterior.position_m), answer.text


def measure(folder: Path) -> int:
    asked = questions()
    tallies = {name: Tally() for name in ("kernel", "1 client", "16 clients", "16 clients, one core")}
    with server(folder) as (pid, port):
        context = open_context(Settings(data_dir=folder))
        floor = make_floor(port, context)
        floors = prepared(context, floor)
        path = f"/v1/floors/{floor}/locate"
        check_equal(port, path, floors, asked)
        all_cores = os.sched_getaffinity(pid)
        clients = Clients(port, path, asked)
        for _ in range(ROUNDS):
            for name, tally in tallies.items():
                if name == "kernel":
                    tally.add(*ask_kernel(floors, asked, TURN_S))
                    continue
                hold_on(pid, {min(all_cores)} if "one core" in name else all_cores)
                before_s = cpu_s_of(pid)
                wall_s, took_ms = clients.turn(int(name.split()[0]))
                tally.add(wall_s, cpu_s_of(pid) - before_s, took_ms)
        clients.close()
    return report(tallies)


def report(tallies: dict[str, Tally]) -> int:
    print(f"{'':22}{'per second':>12}{'per CPU second':>16}{'p50 ms':>9}{'p99 ms':>9}{'p99 / p50':>11}")
    for name, tally in tallies.items():
        p50_ms, p99_ms = tally.quantile_ms(0.5), tally.quantile_ms(0.99)
        print(f"{name:22}{tally.per_s:12.1f}{tally.per_cpu_s:16.1f}{p50_ms:9.2f}{p99_ms:9.2f}{p99_ms / p50_ms:11.2f}")
    kernel, one, many, held = tallies.values()
    print(f"16 clients on {os.cpu_count()} cores: {many.per_s / kernel.per_s:.2f} times one thread of the kernel")
    on_one_core, per_cpu_s = held.per_s / kernel.per_s, many.per_cpu_s / kernel.per_cpu_s
    tail = many.quantile_ms(0.99) / many.quantile_ms(0.5)
    overhead_ms = one.quantile_ms(0.5) - kernel.quantile_ms(0.5)
    verdicts = [
        ("HTTP / kernel, on one core", on_one_core, f">= {LEAST_SHARE}", on_one_core >= LEAST_SHARE),
        ("HTTP / kernel, per processor second", per_cpu_s, f">= {LEAST_SHARE}", per_cpu_s >= LEAST_SHARE),
        ("p99 / p50, 16 clients", tail, f"<= {MOST_TAIL:g}", tail <= MOST_TAIL),
        ("overhead of 1 client, median ms", overhead_ms, f"< {MOST_OVERHEAD_MS:g}", overhead_ms < MOST_OVERHEAD_MS),
    ]
    for what, value, target, met in verdicts:
        print(f"{what:38}{value:8.2f}   target {target:8}{'PASS' if met else 'FAIL'}")
    return 0 if all(met for *_, met in verdicts) else 1


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--clients", action="store_true", help="be the clients (started by this script)")
    if parser.parse_args().clients:
        be_clients()
        return 0
    with tempfile.TemporaryDirectory() as folder:
        return measure(Path(folder))


if __name__ == "__main__":
    with threadpool_limits(1):  # as the server does
        sys.exit(main())
