"""Which waiting jobs go to the engine next (docs/decisions/0016).

Jobs wait in our own table. They are handed to the engine only as slots of live workers are free, because the engine
draws floors at random: what it holds must be what should run now. Among organisations it is the turn of the one with
the fewest jobs in hand, then of the one whose last turn is longest ago; within one it goes by priority, then by age.
"""

from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache

from sqlalchemy import Select, bindparam, func, or_, select
from sqlalchemy.orm import Session, aliased

from app.db.engine import lock_for_transaction
from app.db.tables import Job, Worker

__all__ = ["HIGH", "IN_HAND", "LOW", "NORMAL", "admit_next", "has_admitted", "live_slots"]

HIGH, NORMAL, LOW = 1, 2, 3
"""Priorities, the first served first. What somebody asked for is normal, what follows from an upload is low."""

IN_HAND = or_(Job.status == "running", (Job.status == "accepted") & Job.admitted_at.is_not(None))
"""Jobs that the engine has: as many as there are slots, however many wait."""

_FLOORS_IN_HAND = select(Job.organisation_id, Job.floor_id).where(IN_HAND)
_LIVE_SLOTS = select(Worker.id, Worker.slots).where(Worker.state == "live")
_ADMITTED = select(Job.id).where(Job.status == "accepted", Job.admitted_at.is_not(None)).limit(1)

LONG_AGO = datetime(1970, 1, 1, tzinfo=UTC)
ADMISSION_LOCK = 0x150D_12  # any constant of our own: PostgreSQL's advisory locks are numbers


@dataclass(slots=True)
class _Turn:
    """Where an organisation stands: its jobs in hand, when it had its last turn, and what it has waiting."""

    in_hand: int
    last: datetime
    waiting: list[Job]


def admit_next(session: Session) -> list[Job]:
    """Mark as admitted, and return, the jobs that the free slots are for; never two of one floor.

    One transaction at a time, until it ends; it must have locked whatever else it needs before.
    """
    lock_for_transaction(session, ADMISSION_LOCK)
    session.flush()
    in_hand = session.execute(_FLOORS_IN_HAND).all()
    room = sum(live_slots(session).values()) - len(in_hand)
    if room <= 0:
        return []
    turns = _turns(session, room, {row.floor_id for row in in_hand})
    for row in in_hand:
        if row.organisation_id in turns:
            turns[row.organisation_id].in_hand += 1
    admitted: list[Job] = []
    while turns and len(admitted) < room:
        organisation_id, turn = min(
            turns.items(), key=lambda item: (item[1].in_hand, item[1].last, item[1].waiting[0].id)
        )
        job = turn.waiting.pop(0)
        job.admitted_at = turn.last = datetime.now(UTC)
        turn.in_hand += 1
        admitted.append(job)
        if not turn.waiting:
            del turns[organisation_id]
    session.flush()
    return admitted


def has_admitted(session: Session) -> bool:
    """Whether the engine has a job that no worker has begun."""
    return session.scalar(_ADMITTED) is not None


def live_slots(session: Session) -> dict[str, int]:
    """By live worker, the jobs it runs at one time. One of an older version admits nobody: with it there, all are."""
    return {row.id: 2**31 if row.slots is None else row.slots for row in session.execute(_LIVE_SLOTS)}


def _turns(session: Session, room: int, busy_floors: set[str]) -> dict[str, _Turn]:
    """The organisations with jobs that could start, each with the first `room` of them, one a floor."""
    turns: dict[str, _Turn] = {}
    for job, last in session.execute(_first_waiting(), {"room": room, "busy_floors": list(busy_floors)}):
        turns.setdefault(job.organisation_id, _Turn(0, last or LONG_AGO, [])).waiting.append(job)
    return turns


@cache  # building it takes ten times as long as running it
def _first_waiting() -> Select[Job, datetime | None]:
    """The first `room` jobs of each organisation, on floors other than `busy_floors`, and its last turn."""
    order = (Job.priority, Job.id)
    of_floor = (
        select(
            Job.id, Job.organisation_id, Job.priority,
            func.row_number().over(partition_by=Job.floor_id, order_by=order).label("place"),
        )
        .where(
            Job.status == "accepted", Job.admitted_at.is_(None),
            Job.floor_id.not_in(bindparam("busy_floors", expanding=True)),
        )
        .subquery()
    )  # fmt: skip
    of_organisation = (
        select(
            of_floor.c.id,
            func.row_number()
            .over(partition_by=of_floor.c.organisation_id, order_by=(of_floor.c.priority, of_floor.c.id))
            .label("place"),
        )
        .where(of_floor.c.place == 1)
        .subquery()
    )
    earlier = aliased(Job)
    last_turn = (
        select(func.max(earlier.admitted_at)).where(earlier.organisation_id == Job.organisation_id).scalar_subquery()
    )
    return (
        select(Job, last_turn)
        .join(of_organisation, of_organisation.c.id == Job.id)
        .where(of_organisation.c.place <= bindparam("room"))
        .order_by(*order)
        .with_for_update(of=Job, skip_locked=True)  # whoever changes one now comes here, too, before it ends
        .execution_options(populate_existing=True)
    )
