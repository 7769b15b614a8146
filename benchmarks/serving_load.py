"""Many buildings, a hundred of them hot: how a web process answers as it fills up, and what a second one adds.

An installation of 2,000 buildings of five floors each; every floor has an active map. Windows of 20 samples over 8 m
with a prior of 5 m, heading unknown, anywhere in one of the hot buildings; all five floors are searched. In one run:

- `--load`: what one process answers at most (16 clients, each sends its next window when it has an answer), then an
  open loop at 80 % of that: windows come by chance (Poisson), whether or not the last ones were answered, and a latency
  counts from when a window was due. Target: p99 at most 5 times p50. One window of a hundred is of a building nobody
  asked for lately; such windows are told apart.
- `--scale`: one process held on one core against two on two, in turns, the clients where there is room. Target: 1.7.
- `--minutes N`: memory of a process under half of its most, every ten seconds, after so many buildings were asked for
  that the cache of maps is full; least squares over the second half. Target: its last quarter is less than 2 % above
  its third.

The clients are processes of their own with plain sockets. Linux only; exits non-zero when a target is missed.
"""

import argparse
import asyncio
import json
import os
import random
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from http_overhead import KEY, wait_until_ready
from sqlalchemy import insert, select

from app.db.tables import Building, Floor, Map, Organisation, new_id
from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.geometry import yaw_matrix
from app.main import first_start, open_context
from app.services.artefacts import grid_to_bytes
from app.settings import Settings

BUILDINGS, FLOORS, HOT, KINDS = 2000, 5, 100, 50
WIDTH_M, DEPTH_M, CELL_M = 30.0, 20.0, 0.25
SAMPLES, WALKED_M, NOISE_UT, PRIOR_SD_M = 20, 8.0, 0.4, 5.0
COLD_SHARE = 0.01
CLIENTS, TURN_S, ROUNDS = 16, 6.0, 4
OPEN_LOOP_S, FILLED = 60.0, 0.8
MOST_TAIL, LEAST_SCALE, MOST_GROWTH = 5.0, 1.7, 0.02


def field_uT(kind: int, p: np.ndarray) -> np.ndarray:
    """The field of a kind of floor: waves of unrelated lengths."""
    rng = np.random.default_rng(kind)
    k, phase, way = rng.normal(0, 0.8, (40, 2)), rng.uniform(0, 6.28, 40), rng.normal(0, 1.0, (40, 3))
    return np.array([18.0, 3.0, -42.0]) + np.cos(p @ k.T + phase) @ way


def grid_of(kind: int) -> FieldGrid:
    x, y = np.arange(0, WIDTH_M, CELL_M), np.arange(0, DEPTH_M, CELL_M)
    mean = field_uT(kind, np.stack(np.meshgrid(x, y), axis=-1))[None]
    slope = np.stack([np.gradient(mean, CELL_M, axis=2), np.gradient(mean, CELL_M, axis=1)], axis=-1)
    return FieldGrid(
        components="vector", origin_m=(0.0, 0.0), resolution_m=CELL_M, heights_m=np.array([1.2]),
        mean_uT=mean.astype(np.float32), sd_uT=np.full(mean.shape, 0.3, np.float32),
        gradient_uT_per_m=slope.astype(np.float32), measured=np.ones(mean.shape[:3], dtype=np.bool_),
        ambient_uT=np.array([18.0, 3.0, -42.0]), prior_sd_uT=np.full(3, 5.0), noise_sd_uT=np.full(3, NOISE_UT),
        error_correlation_m=0.0, error_structure=ErrorStructure(0.0, 0.0, 1.0, 1.0),
    )  # fmt: skip


def settle(folder: Path) -> list[tuple[str, int]]:
    """Make the installation. Returns the buildings, each with the kind of its ground floor."""
    settings = Settings(data_dir=folder, admin_key=KEY)
    first_start(settings)
    context = open_context(settings)
    kinds = [context.blobs.put(grid_to_bytes(grid_of(kind))) for kind in range(KINDS)]
    with context.transaction() as session:
        owner = session.scalars(select(Organisation.id)).one()
        made = [(new_id(), number % KINDS) for number in range(BUILDINGS)]
        session.execute(
            insert(Building), [{"id": building, "organisation_id": owner, "name": "B"} for building, _ in made]
        )
        floors, maps = [], []
        for building, kind in made:
            for ordinal in range(FLOORS):
                of_map = {"id": new_id(), "floor_id": new_id(), "organisation_id": owner}
                sha256 = kinds[(kind + ordinal) % KINDS]
                maps.append({**of_map, "status": "ready", "spec": {}, "survey_ids": [], "components": "vector",
                             "grid_sha256": sha256})  # fmt: skip
                floors.append({"id": of_map["floor_id"], "organisation_id": owner, "building_id": building,
                               "name": str(ordinal), "ordinal": ordinal, "elevation_m": 3.0 * ordinal,
                               "active_map_id": of_map["id"]})  # fmt: skip
        session.execute(insert(Floor), floors)
        session.execute(insert(Map), maps)
    context.queue.close()
    context.engine.dispose()
    return made


def question(kind: int, rng: np.random.Generator) -> str:
    turn = yaw_matrix(rng.uniform(-np.pi, np.pi))
    walked = np.column_stack([np.linspace(0, WALKED_M, SAMPLES), np.zeros((SAMPLES, 2))])
    p = rng.uniform([9, 9], [WIDTH_M - 9, DEPTH_M - 9]) + (walked @ turn.T)[:, :2]
    B = (field_uT(kind, p) + rng.normal(0, NOISE_UT, (SAMPLES, 3))) @ turn
    x, y = p[-1] + rng.normal(0, PRIOR_SD_M / 2, 2)
    window = {"frame": "level", "b_ut": B.tolist(), "displacement_m": walked.tolist(), "noise_ut": NOISE_UT}
    return json.dumps({"window": window, "prior": {"position_m": [x, y, 1.2], "sd_m": PRIOR_SD_M}})


@contextmanager
def server(folder: Path, cores: set[int] | None = None) -> Iterator[tuple[int, int]]:
    """A web process, on these cores only: its id and its port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {**os.environ, "ISODYN_DATA_DIR": str(folder), "ISODYN_ADMIN_KEY": KEY, "ISODYN_PORT": str(port),
                   "ISODYN_GRID_CACHE_BYTES": str(2**30), "ISODYN_LOG_LEVEL": "warning"}  # fmt: skip
    hold = ["taskset", "--cpu-list", ",".join(map(str, sorted(cores)))] if cores else []
    start = time.perf_counter()
    process = subprocess.Popen([*hold, sys.executable, "-m", "app.cli", "serve", "--no-worker"], env=environment)
    try:
        wait_until_ready(port, start)
        time.sleep(5.0)  # warming up goes on beside the first answers
        yield process.pid, port
    finally:
        process.terminate()
        process.wait()


class Clients:
    """Clients in a process of their own, which waits for orders."""

    def __init__(self, hot: Sequence[tuple[str, int]], cold: Sequence[tuple[str, int]]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--clients"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self._ask({"hot": hot, "cold": cold})

    def closed(self, ports: Sequence[int], turn_s: float) -> float:
        """Answers per second, of as many clients as can be kept waiting."""
        done = self._ask({"ports": ports, "clients": CLIENTS, "turn_s": turn_s})
        return len(done) / turn_s

    def open(self, ports: Sequence[int], per_s: float, turn_s: float) -> np.ndarray:
        """Of every window, (milliseconds from when it was due to its answer, whether its building was cold, whether it
        was answered and not refused)."""
        return np.array(self._ask({"ports": ports, "per_s": per_s, "turn_s": turn_s}))

    def fill(self, port: int) -> None:
        """A window in every building, the hot ones last."""
        self._ask({"ports": [port], "fill": True})

    def _ask(self, order: dict[str, object]) -> list[Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(order), file=self._process.stdin, flush=True)
        answer: list[Any] = json.loads(self._process.stdout.readline())
        return answer

    def close(self) -> None:
        self._process.communicate()


def be_clients() -> None:
    """The other side of `Clients`."""
    rng = np.random.default_rng(7)
    where = json.loads(sys.stdin.readline())

    def requests(buildings: Sequence[Any], each: int) -> list[bytes]:
        made = []
        for building, kind in buildings:
            head = (
                f"POST /v1/buildings/{building}/locate HTTP/1.1\r\nHost: localhost\r\n"
                f"Authorization: Bearer {KEY}\r\nContent-Type: application/json\r\n"
            )
            for body in (question(kind, rng) for _ in range(each)):
                made.append(f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode())
        return made

    hot, cold = requests(where["hot"], 4), requests(where["cold"], 1)
    print("[]", flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        if "fill" in order:
            answered = asyncio.run(_fill(order["ports"][0], [*cold, *hot[::4]]))
        elif "clients" in order:
            answered = asyncio.run(_closed(order["ports"], hot, order["clients"], order["turn_s"]))
        else:
            answered = asyncio.run(_open(order["ports"], hot, cold, order["per_s"], order["turn_s"]))
        print(json.dumps(answered), flush=True)


async def _ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: bytes) -> bool:
    """Whether it was answered; False where the server has too much to do."""
    writer.write(request)
    answer = await reader.readuntil(b"\r\n\r\n")
    assert answer.startswith((b"HTTP/1.1 200", b"HTTP/1.1 503")), answer + await reader.read(500)
    length = next(line for line in answer.lower().split(b"\r\n") if line.startswith(b"content-length:"))
    await reader.readexactly(int(length.split(b":")[1]))
    return answer.startswith(b"HTTP/1.1 200")


async def _fill(port: int, requests: Sequence[bytes]) -> list[float]:
    """Every window once, by a few clients."""
    left = list(reversed(requests))

    async def client() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        while left:
            request = left.pop()
            while not await _ask(reader, writer, request):
                await asyncio.sleep(0.5)
        writer.close()

    await asyncio.gather(*(client() for _ in range(4)))
    return []


async def _closed(ports: Sequence[int], requests: Sequence[bytes], clients: int, turn_s: float) -> list[float]:
    """Each client sends its next window as soon as it has the answer to the last."""
    took_ms: list[float] = []
    until = time.perf_counter() + turn_s

    async def client(number: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", ports[number % len(ports)])
        draw = random.Random(number)
        while (before := time.perf_counter()) < until:
            if await _ask(reader, writer, draw.choice(requests)):
                took_ms.append(1e3 * (time.perf_counter() - before))
            else:
                await asyncio.sleep(0.5)
        writer.close()

    await asyncio.gather(*(client(number) for number in range(clients)))
    return took_ms


async def _open(
    ports: Sequence[int], hot: Sequence[bytes], cold: Sequence[bytes], per_s: float, turn_s: float
) -> list[tuple[float, bool, bool]]:
    """Windows come by chance, whether or not the last ones were answered; a connection is taken up again."""
    draw, answered = random.Random(11), []
    idle: list[tuple[asyncio.StreamReader, asyncio.StreamWriter]] = []
    start = time.perf_counter()
    due = start

    async def one(due: float) -> None:
        is_cold = draw.random() < COLD_SHARE
        request = draw.choice(cold if is_cold else hot)
        used = idle.pop() if idle else None
        way = used or await asyncio.open_connection("127.0.0.1", draw.choice(ports))
        try:
            done = await _ask(*way, request)
        except (ConnectionError, asyncio.IncompleteReadError):  # the server closes what is idle for long
            if used is None:
                raise
            way = await asyncio.open_connection("127.0.0.1", draw.choice(ports))
            done = await _ask(*way, request)
        answered.append((1e3 * (time.perf_counter() - due), is_cold, done))
        idle.append(way)

    async with asyncio.TaskGroup() as group:
        while (due := due + draw.expovariate(per_s)) < start + turn_s:
            await asyncio.sleep(max(due - time.perf_counter(), 0.0))
            group.create_task(one(due))
    for _, writer in idle:
        writer.close()
    return answered


def warm(clients: Clients, ports: Sequence[int]) -> None:
    """Until every hot building has been asked for in every process."""
    for port in ports:
        clients.closed([port], 4 * TURN_S)


def load(folder: Path, clients: Clients) -> bool:
    with server(folder) as (_, port):
        warm(clients, [port])
        most = float(np.median([clients.closed([port], TURN_S) for _ in range(ROUNDS)]))
        print(f"one process answers at most {most:.0f} windows a second, each searching {FLOORS} floors")
        passed = True
        for filled in (0.2, 0.5, FILLED, 0.9):
            came = clients.open([port], filled * most, OPEN_LOOP_S)
            answered = came[came[:, 2] == 1]
            hot = answered[answered[:, 1] == 0, 0]
            cold = answered[answered[:, 1] == 1, 0]
            p50, p99 = np.quantile(answered[:, 0], [0.5, 0.99])
            cold_ms = f"{np.median(cold):.1f} ms" if len(cold) else "none came"
            print(
                f"open loop at {filled:.0%} ({len(came)} windows, {len(came) - len(answered)} refused): "
                f"p50 {p50:.1f}, p99 {p99:.1f} ms, {p99 / p50:.1f} times; "
                f"hot buildings p99 {np.quantile(hot, 0.99):.1f}, cold ones p50 {cold_ms}"
            )
            passed &= filled != FILLED or (p99 <= MOST_TAIL * p50 and len(answered) == len(came))
    print(f"at {FILLED:.0%} p99 at most {MOST_TAIL:.0f} times p50: {'met' if passed else 'MISSED'}")
    return bool(passed)


def scale(folder: Path, clients: Clients) -> bool:
    with server(folder, {0}) as (_, first), server(folder, {1}) as (_, second):
        warm(clients, [first, second])
        ratios, one = [], []
        for _ in range(ROUNDS):
            alone = [clients.closed([port], TURN_S) for port in (first, second)]
            both = clients.closed([first, second], 2 * TURN_S)
            one += alone
            ratios.append(both / float(np.mean(alone)))
    ratio = float(np.median(ratios))
    print(
        f"one process on one core {np.mean(one):.0f} a second; two on two {ratio:.2f} times (of {np.round(ratios, 2)})"
    )
    print(f"at least {LEAST_SCALE} times: {'met' if ratio >= LEAST_SCALE else 'MISSED'}")
    return ratio >= LEAST_SCALE


def rss_mib(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def memory(folder: Path, clients: Clients, minutes: float) -> bool:
    with server(folder) as (pid, port):
        clients.fill(port)
        most = clients.closed([port], TURN_S)
        at_s, mib, over = [], [], threading.Event()
        start = time.monotonic()

        def watch() -> None:
            while not over.wait(min(10.0, 0.6 * minutes)):
                with suppress(FileNotFoundError):
                    at_s.append(time.monotonic() - start)
                    mib.append(rss_mib(pid))

        watching = threading.Thread(target=watch)
        watching.start()
        answers = len(clients.open([port], 0.5 * most, 60.0 * minutes))
        over.set()
        watching.join()
    later = np.array(at_s) > 30.0 * minutes
    slope = float(np.polyfit(np.array(at_s)[later] / 3600, np.array(mib)[later], 1)[0])
    half = np.array(mib)[later]
    grown = float(half[-len(half) // 4 :].mean() / half[: len(half) // 4].mean() - 1)
    told = f"{mib[0]:.0f} MiB at first, {half[0]:.0f} at half time, {half[-1]:.0f} at the end"
    print(f"{minutes:.0f} minutes, {answers} windows: {told}; {slope:+.1f} MiB an hour; second half {grown:+.2%}")
    print(f"second half by less than {MOST_GROWTH:.0%}: {'met' if grown < MOST_GROWTH else 'MISSED'}")
    return grown < MOST_GROWTH


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--clients", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--load", action="store_true")
    parser.add_argument("--scale", action="store_true")
    parser.add_argument("--minutes", type=float)
    arguments = parser.parse_args()
    if arguments.clients:
        be_clients()
        return 0
    everything = not (arguments.load or arguments.scale or arguments.minutes)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        buildings = settle(folder)
        clients = Clients(buildings[:HOT], buildings[HOT : HOT + 500])
        passed = True
        if arguments.load or everything:
            passed &= load(folder, clients)
        if arguments.scale or everything:
            passed &= scale(folder, clients)
        if arguments.minutes:
            passed &= memory(folder, clients, arguments.minutes)
        clients.close()
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
