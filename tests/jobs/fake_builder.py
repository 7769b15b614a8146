"""A builder without mathematics for the worker's tests: sleeps in slices, and writes a diary beside the blobs.

What a fit does is said by the map's spec or, for rebuilds, by the floor's name: a JSON object with `sleep_s`, `fail`,
`die_times`, `silent`; `claim_s` holds the floor locked that long, `hold_s` keeps the fit's interpreter busy and lets no
other thread in, `kill_worker` takes the worker down with the fit. `chunks` are offered to other workers for as long as
`sleep_s`, or until all are brought; each takes them `chunk_s`, or `kill_helper`
takes the worker down that took it, or it fails with `fail_chunk`.
"""

import json
import os
import signal
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app.blobs import BlobStore
from app.db.tables import Floor, Job, Map, Survey
from app.errors import InvalidInput
from app.services.shared_tiles import Board

DIARY = Path(os.environ["ISODYN_TEST_DIARY"])


def note(event: str, **facts: object) -> None:
    line = json.dumps({"event": event, "at": time.time(), "pid": os.getpid(), **facts}) + "\n"
    with DIARY.open("a") as diary:
        diary.write(line)


def claim_build(session: Session, job_id: str) -> dict[str, Any]:
    job = session.get_one(Job, job_id)
    floor = session.get_one(Floor, job.floor_id, populate_existing=True)
    row = session.get(Map, job.map_id) if job.map_id else None
    if row is None:
        row = Map(
            organisation_id=job.organisation_id,
            floor_id=floor.id,
            status="running",
            spec={},
            survey_ids=[],
            activate=True,
        )
        session.add(row)
        session.flush()
        job.map_id = row.id
    if row.sequence == 0:
        floor.build_sequence += 1
        row.sequence = floor.build_sequence
        row.survey_ids = list(session.scalars(select(Survey.id).where(Survey.floor_id == floor.id)))
    job.status = row.status = "running"
    job.started_at = datetime.now(UTC)
    orders = {**json.loads(floor.name), **row.spec}
    if "claim_s" in orders:
        note("claim starts", floor_id=floor.id)
        time.sleep(orders["claim_s"])
    if orders.get("fail_claim"):
        raise InvalidInput("there is nothing to build; upload a survey")
    return {"map_id": row.id, "floor_id": floor.id, "sequence": row.sequence, "surveys": row.survey_ids, **orders}


def fit_build(
    plan: dict[str, Any], blobs: BlobStore, progress: Callable[[float, str], None], board: Board | None
) -> dict[str, Any]:
    note("fit starts", floor_id=plan["floor_id"], map_id=plan["map_id"], surveys=plan["surveys"], worker=os.getppid())
    if plan.get("fail"):
        raise InvalidInput("the walks do not overlap; walk the floor again")
    if plan.get("break"):
        raise ZeroDivisionError("a fault of the program")
    started = sum(e["event"] == "fit starts" and e["map_id"] == plan["map_id"] for e in map(json.loads, open(DIARY)))  # noqa: PTH123, SIM115
    if started <= plan.get("die_times", 0):
        os.kill(os.getpid(), signal.SIGKILL)
    if plan.get("kill_worker"):
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)
    began = time.monotonic()
    while time.monotonic() - began < plan.get("hold_s", 0.0):
        sum(range(50_000_000))  # a second or so in compiled code that never lets go of the interpreter
    slices, chunks = max(1, round(plan.get("sleep_s", 0.2) / 0.05)), plan.get("chunks", 0)
    if board is not None and chunks:
        board.offer(blobs.put(json.dumps(plan).encode()), chunks)
    for n in range(slices):
        if board is not None and chunks and _all_brought(plan, board):
            break
        if not plan.get("silent"):
            progress(n / slices, f"slice {n} of {slices}")
        time.sleep(0.05)
    if chunks:
        taken = {} if board is None else board.taken()
        brought = {number: blobs.get(sha256).decode() for number, sha256 in taken.items() if sha256}
        note("brought", floor_id=plan["floor_id"], brought=brought, taken=sorted(taken))
        if board is not None:
            board.withdraw()
    sha256 = blobs.put(json.dumps(sorted(plan["surveys"])).encode())
    note("fit ends", floor_id=plan["floor_id"], map_id=plan["map_id"])
    return {"sha256": sha256}


def _all_brought(plan: dict[str, Any], board: Board) -> bool:
    """Or nothing is to be waited for any more."""
    if plan.get("kill_helper"):
        return '"chunk starts"' in DIARY.read_text().split(plan["map_id"])[-1]
    return sum(sha256 is not None for sha256 in board.taken().values()) == plan["chunks"]


def fit_chunk(
    order_sha256: str, number: int, blobs: BlobStore, progress: Callable[[float, str], None]
) -> dict[str, Any]:
    plan = json.loads(blobs.get(order_sha256))
    note("chunk starts", floor_id=plan["floor_id"], number=number, worker=os.getppid())
    if plan.get("kill_helper"):
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)
    if plan.get("fail_chunk"):
        raise InvalidInput("no memory for that here")
    time.sleep(plan.get("chunk_s", 0.0))
    progress(1.0, "done")
    return {"fits_sha256": blobs.put(f"chunk {number}".encode())}


def publish_build(session: Session, job_id: str, plan: dict[str, Any], result: dict[str, Any]) -> None:
    row, job = session.get_one(Map, plan["map_id"]), session.get_one(Job, job_id)
    newer = update(Floor).where(Floor.id == plan["floor_id"], Floor.active_sequence < plan["sequence"])
    session.execute(newer.values(active_map_id=row.id, active_sequence=plan["sequence"]))
    row.status, row.grid_sha256 = "ready", result["sha256"]
    job.status, job.progress, job.message, job.result = "successful", 100, "the map is ready", result
    job.finished_at = datetime.now(UTC)


def fail_build(session: Session, job_id: str, message: str) -> None:
    _end(session, job_id, "failed", message)


def dismiss_build(session: Session, job_id: str) -> None:
    _end(session, job_id, "dismissed", "cancelled")


def _end(session: Session, job_id: str, status: str, message: str) -> None:
    job = session.get_one(Job, job_id)
    if job.status in ("successful", "failed", "dismissed"):
        return
    job.status, job.message, job.finished_at = status, message, datetime.now(UTC)
    note("ended", status=status)
