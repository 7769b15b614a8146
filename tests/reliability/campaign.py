"""A stream of uploads and rebuilds while everything that can die does, and what is left of it afterwards.

`python -m tests.reliability.campaign --uploads 300` runs both back ends and prints what was seen; a shorter one is a
test. Clients send a survey again until it is acknowledged, as any client must; from then on it may never be lost. A
watcher looks all the time at what readers see. At the end every floor is built once more as somebody asked for it
(learned anew, so that it depends on its surveys alone), here and in an installation that nothing happened to.
"""

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from hashlib import sha256
from itertools import cycle
from pathlib import Path
from random import Random
from threading import Event, Thread
from typing import Any, Self, cast

import httpx
import numpy as np

from app.jobs import FINAL_STATES
from app.synthetic.hall import hall_uT
from tests.reliability.installation import KEY, BackEnd, Installation, installation

__all__ = ["Seen", "run_campaign"]

NOISE_UT = 0.4
REFUSED = (503, 507)  # told to come again: nothing was acknowledged
PATIENCE_S = 300.0
FLOORS = 6
CLIENTS = 3


def walk_csv(floor: int, number: int) -> bytes:
    """A walk of 40 m through the hall, another for each number, and another field for each floor."""
    rng = np.random.default_rng([floor, number])
    corners = rng.uniform([0.5, 0.5], [11.5, 7.5], (8, 2))
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.arange(0.0, along[-1], 0.2)
    p = np.stack([np.interp(at, along, corners[:, k]) for k in (0, 1)], axis=1)
    B = hall_uT(p[:, 0] + 3.0 * floor, p[:, 1]) + rng.normal(0.0, NOISE_UT, (len(p), 3))
    rows = np.column_stack([0.2 * np.arange(len(p)), p, np.full(len(p), 1.2), B])
    lines = "\n".join(",".join(f"{value:.4f}" for value in row) for row in rows)
    return f"t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n{lines}\n".encode()


@dataclass
class Seen:
    """What came of a campaign."""

    acknowledged: dict[str, str] = field(default_factory=dict)
    """Of every acknowledged survey the hash of its bytes."""
    faults: Counter[str] = field(default_factory=Counter)
    refused: int = 0
    interrupted: int = 0
    looks: int = 0
    wrong: list[str] = field(default_factory=list)
    """Answers that no client should ever see, and maps seen by halves."""
    lost: list[str] = field(default_factory=list)
    jobs: Counter[str] = field(default_factory=Counter)
    unended: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    maps: dict[int, str] = field(default_factory=dict)
    """Of every floor the hash of its last map."""
    seconds: float = 0.0

    def told(self) -> str:
        faults = ", ".join(f"{count} x {name}" for name, count in sorted(self.faults.items()))
        jobs = ", ".join(f"{count} {status}" for status, count in sorted(self.jobs.items()))
        return (
            f"{len(self.acknowledged)} uploads acknowledged in {self.seconds:.0f} s; {faults or 'no fault'}\n"
            f"  refused and sent again {self.refused}, cut off and sent again {self.interrupted}\n"
            f"  acknowledged and lost: {len(self.lost)}; wrong answers and half-visible maps in {self.looks} looks: "
            f"{len(self.wrong)}\n  jobs: {jobs}; without an end: {len(self.unended)}"
            + "".join(f"\n  failed: {each}" for each in (*self.failed, *self.lost, *self.wrong))
        )


class Client:
    """Somebody who sends again what was not acknowledged, to whichever server answers."""

    def __init__(self, addresses: Sequence[str], seen: Seen) -> None:
        headers = {"Authorization": f"Bearer {KEY}"}
        self._all = [httpx.Client(base_url=each, headers=headers, timeout=60.0) for each in addresses]
        self._https = cycle(self._all)
        self._http = next(self._https)
        self._seen = seen

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for http in self._all:
            http.close()

    def ask(self, method: str, path: str, **arguments: Any) -> Any:
        """The JSON of the answer, once there is one. Raises AssertionError for one that should never be."""
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            try:
                answer = self._http.request(method, path, **arguments)
            except httpx.TransportError:
                self._seen.interrupted += 1
                self._http = next(self._https)
                time.sleep(0.2)
                continue
            if answer.status_code in REFUSED:
                self._seen.refused += 1
                self._http = next(self._https)
                time.sleep(0.5)
                continue
            if answer.is_error:
                told = f"{method} {path}: {answer.status_code} {answer.text[:300]}"
                self._seen.wrong.append(told)
                raise AssertionError(told)
            return answer.json()
        raise AssertionError(f"{method} {path}: no answer for {PATIENCE_S:.0f} s")

    def pages(self, path: str) -> Iterator[Any]:
        """Every item of a list."""
        page: Any = {"links": {"next": path}}
        while "next" in page["links"]:
            page = self.ask("GET", page["links"]["next"])
            yield from page["items"]


def run_campaign(
    site: Installation,
    uploads: int,
    *,
    seed: int = 1,
    every_s: float = 0.0,
    pace_s: float = 0.0,
    auto_build: bool = True,
) -> Seen:
    """Send so many surveys, with a fault every `every_s` seconds or so (0: none), wait for all that follows, and look.

    Each client waits `pace_s` after each; the order in which a floor gets its surveys is always the same.
    """
    seen, start = Seen(), time.monotonic()
    with Client(site.addresses, seen) as client:
        floors = _settle(client, auto_build)
        with _watched(site, seen, floors):
            with _bad_days(site, seen, seed, every_s), ThreadPoolExecutor(CLIENTS) as pool:
                streams = [pool.submit(_upload, site, seen, floors, k, uploads, pace_s) for k in range(CLIENTS)]
                for stream in streams:
                    stream.result()
            _wait_for_jobs(client, seen)
            _look_for_losses(client, seen, floors)
            for k, floor in enumerate(floors):
                headers = {"Idempotency-Key": f"last-{k}"}
                job = client.ask("POST", f"/v1/floors/{floor}/maps", json={}, headers=headers)["job"]
                seen.maps[k] = str(_ended(client, job["id"])["result"]["sha256"])
    seen.seconds = time.monotonic() - start
    return seen


def _settle(client: Client, auto_build: bool) -> list[str]:
    """A building: its floors."""
    building = client.ask("POST", "/v1/buildings", json={"name": "House"}, headers={"Idempotency-Key": "house"})["id"]
    floors = []
    for k in range(FLOORS):
        body = {"name": str(k), "ordinal": k, "elevation_m": 0.0, "auto_build": auto_build}
        headers = {"Idempotency-Key": f"floor-{k}"}
        floors.append(client.ask("POST", f"/v1/buildings/{building}/floors", json=body, headers=headers)["id"])
    return floors


def _upload(site: Installation, seen: Seen, floors: Sequence[str], client: int, uploads: int, pace_s: float) -> None:
    """One client's share, to one of its floors after the other."""
    with Client(site.addresses, seen) as http:
        for number in range(client, uploads, CLIENTS):
            floor = number % FLOORS
            walk = walk_csv(floor, number)
            survey = http.ask("POST", f"/v1/floors/{floors[floor]}/surveys", content=walk)["survey"]
            seen.acknowledged[survey["id"]] = sha256(walk).hexdigest()
            time.sleep(pace_s)


@contextmanager
def _bad_days(site: Installation, seen: Seen, seed: int, every_s: float) -> Iterator[None]:
    """One fault after the other, each of another kind, until what is inside has been done."""
    over = Event()

    def happen() -> None:
        draw = Random(seed)
        bag: list[Any] = []
        while not over.wait(draw.uniform(0.5, 1.5) * every_s):
            if not bag:
                bag = draw.sample(site.faults, len(site.faults))
            fault = bag.pop()
            fault.happen(draw)
            seen.faults[fault.name] += 1

    thread = Thread(target=happen, daemon=True)
    if every_s:
        thread.start()
    try:
        yield
    finally:
        over.set()
        if every_s:
            thread.join()


@contextmanager
def _watched(site: Installation, seen: Seen, floors: Sequence[str]) -> Iterator[None]:
    """A reader looks at every floor's map again and again: it is whole, and never an older one."""
    over = Event()

    def watch() -> None:
        surveys = dict.fromkeys(floors, 0)
        with Client(site.addresses, seen) as client:
            for floor in cycle(floors):
                if over.wait(0.1):
                    return
                with suppress(AssertionError):  # told already
                    _look(client, seen, floor, surveys)

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _look(client: Client, seen: Seen, floor: str, surveys: dict[str, int]) -> None:
    """At what a reader sees of a floor; `surveys` are those its map had before."""
    active = client.ask("GET", f"/v1/floors/{floor}")["active_map_id"]
    if active is None:
        return
    told = client.ask("GET", f"/v1/maps/{active}")
    points = {"points_m": [[4.0, 4.0, 1.2], [8.0, 3.0, 1.2]]}
    field = client.ask("POST", f"/v1/maps/{active}/field", json=points)
    client.ask("GET", f"/v1/maps/{active}/quality")
    seen.looks += 1
    if told["status"] != "ready" or len(field["measured"]) != 2:
        seen.wrong.append(f"the active map {active} is {told['status']}, {field['measured']}")
    if len(told["survey_ids"]) < surveys[floor]:
        seen.wrong.append(f"floor {floor} went back from {surveys[floor]} to {len(told['survey_ids'])} surveys")
    surveys[floor] = max(surveys[floor], len(told["survey_ids"]))


def _wait_for_jobs(client: Client, seen: Seen) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while True:
        jobs = list(client.pages("/v1/jobs?limit=200"))
        seen.unended = [
            f"{job['id']} {job['status']}: {job['message']}" for job in jobs if job["status"] not in FINAL_STATES
        ]
        if not seen.unended or time.monotonic() > deadline:
            break
        time.sleep(0.5)
    seen.jobs = Counter(job["status"] for job in jobs)
    seen.failed = [job["message"] for job in jobs if job["status"] == "failed"]


def _ended(client: Client, job_id: str) -> Any:
    deadline = time.monotonic() + PATIENCE_S
    while (job := client.ask("GET", f"/v1/jobs/{job_id}"))["status"] not in FINAL_STATES:
        assert time.monotonic() < deadline, job
        time.sleep(0.2)
    assert job["status"] == "successful", job
    return job


def _look_for_losses(client: Client, seen: Seen, floors: Sequence[str]) -> None:
    """Every acknowledged survey is there with its bytes and samples, and in the map that is active."""
    there, mapped = {}, set()
    for floor in floors:
        there |= {survey["id"]: survey["sha256"] for survey in client.pages(f"/v1/floors/{floor}/surveys?limit=200")}
        active = client.ask("GET", f"/v1/floors/{floor}")["active_map_id"]
        mapped |= set(client.ask("GET", f"/v1/maps/{active}")["survey_ids"]) if active else set()
    for survey, sha in seen.acknowledged.items():
        if there.get(survey) != sha:
            seen.lost.append(f"survey {survey} is not there")
        elif survey not in mapped:
            seen.lost.append(f"survey {survey} is in no map")
        elif not client.ask("GET", f"/v1/surveys/{survey}/samples?limit=10")["rows"]:
            seen.lost.append(f"survey {survey} has no samples")


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.reliability.campaign", description=__doc__.split("\n")[0])
    parser.add_argument("--uploads", type=int, default=300)
    parser.add_argument("--back-end", choices=["sqlite", "postgres"], action="append")
    parser.add_argument("--every", type=float, default=5.0, metavar="S", help="seconds between faults, about")
    parser.add_argument("--outage", type=float, default=10.0, metavar="S", help="how long an outage lasts")
    parser.add_argument("--pace", type=float, default=3.0, metavar="S", help="seconds a client waits after an upload")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    failed = False
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        with installation("sqlite", folder / "undisturbed", 0.0) as site:
            site.start(apis=1, workers=1)
            maps = run_campaign(site, arguments.uploads, auto_build=False).maps
        for back_end in arguments.back_end or ["sqlite", "postgres"]:
            with installation(cast(BackEnd, back_end), folder / back_end, arguments.outage) as site:
                site.start(apis=1 if back_end == "sqlite" else 2, workers=2)
                seen = run_campaign(
                    site, arguments.uploads, seed=arguments.seed, every_s=arguments.every, pace_s=arguments.pace
                )
                print(f"{back_end}: {seen.told()}")
                print(f"  last maps identical to those of the undisturbed run: {seen.maps == maps}", flush=True)
                site.doctor()
                for line in (*seen.lost, *seen.wrong, *seen.unended):
                    print(f"  ! {line}")
                failed |= bool(seen.lost or seen.wrong or seen.unended) or seen.maps != maps
                failed |= seen.jobs["failed"] > 0
                if failed:
                    print(site.logs()[-5000:])
    sys.exit(failed)


if __name__ == "__main__":
    main()
