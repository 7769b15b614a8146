"""Follow a track: steps in, an estimate out, stored before it is answered.

A track's state is held in memory and made again, from the database, when it is not: after a restart, when it was long
unused, or when another process went on with it. Steps of one track are followed one batch after the other; tracks
beside each other, in a few threads, while the commits of all of them go into few transactions.
"""

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from threading import Lock
from weakref import WeakValueDictionary

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Track, utc_now
from app.errors import Conflict, CorruptArtefact, NotFound
from app.services.reach import Reach
from app.services.step_order import Arranged, RawStep, arrange
from app.services.track_estimate import SEARCHING, Told, path_row, settled_row, tell
from app.services.track_log import Batch, TrackLog, Write, batches_of, end_idle, read_state
from app.services.track_spec import StepKind, Trackers, step_kind
from app.services.track_steps import core_step
from app.telemetry.metrics import TRACK_BATCH_SECONDS, TRACK_STEPS
from app.tracking.stored_state import state_from_bytes, state_nbytes, state_to_bytes
from app.tracking.track import Followed, begin, follow
from app.tracking.track_state import Tracker, TrackState

__all__ = ["Follower", "Live", "Outcome", "follow_steps"]

STATE_EVERY = 500
"""Steps after which the state is kept: a restart follows fewer than these again."""
_TRIES = 5


@dataclass(frozen=True, slots=True, eq=False)
class Live:
    """A track as it is held in memory; every batch makes a new one.

    version, batches, next_step, waiting, gaps   as in the track's row
    last          the last step that was followed, as it was sent
    kept_step     number that was waited for when the state was last kept
    """

    track_id: str
    organisation_id: str
    building_id: str
    kind: StepKind
    tracker: Tracker
    state: TrackState
    version: int
    batches: int
    next_step: int
    waiting: tuple[RawStep, ...]
    gaps: tuple[tuple[int, int], ...]
    last: RawStep | None
    estimate: Told
    kept_step: int
    touched_at: datetime
    ended_reason: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What became of a batch, and where the track is now."""

    track_id: str
    next_step: int
    accepted: int
    duplicates: int
    late: int
    waiting: int
    estimate: Told


def follow_steps(
    tracker: Tracker, state: TrackState, steps: Sequence[RawStep], kind: StepKind,
    sequence: int, next_step: int,
) -> tuple[TrackState, Batch]:  # fmt: skip
    """A batch of steps (one at least), and all that is said of them. Raises InvalidInput."""
    path, settled = [], []
    followed: Followed | None = None
    for raw in steps:
        step = core_step(raw, kind)
        followed = follow(tracker, state, step)
        state = followed.state
        path.append(path_row(step, followed))
        settled += [settled_row(place) for place in followed.settled]
    assert followed is not None
    return state, Batch(sequence, tuple(steps), next_step, tell(tracker, followed), path, settled)


class Follower:
    """Follows the tracks of a web process. `pool` runs the mathematics, `capacity_bytes` bounds the states held."""

    def __init__(
        self, engine: Engine, sessions: sessionmaker[Session], trackers: Trackers, pool: Executor, *,
        idle_timeout_s: float, capacity_bytes: int, clock: Callable[[], datetime] = utc_now,
    ) -> None:  # fmt: skip
        self.trackers, self.idle_timeout_s = trackers, idle_timeout_s
        self._sessions, self._pool, self._capacity_bytes, self._clock = sessions, pool, capacity_bytes, clock
        self._log = TrackLog(engine)
        self._live: OrderedDict[str, Live] = OrderedDict()
        self._bytes = 0
        self._memory = Lock()
        self._turns: WeakValueDictionary[str, asyncio.Lock] = WeakValueDictionary()

    async def follow(self, track_id: str, reach: Reach, steps: Sequence[RawStep], flush: bool = False) -> Outcome:
        """Follow a batch, whole or not at all, and store it.

        Raises NotFound, Conflict (it has ended), InvalidInput (a fault in a step, nothing was followed).
        """
        with TRACK_BATCH_SECONDS.time():
            outcome = await self._follow_in_turn(track_id, reach, steps, flush)
        for name in ("accepted", "duplicates", "late"):
            TRACK_STEPS.labels(name).inc(getattr(outcome, name))
        return outcome

    async def _follow_in_turn(self, track_id: str, reach: Reach, steps: Sequence[RawStep], flush: bool) -> Outcome:
        loop = asyncio.get_running_loop()
        turn = self._turns.setdefault(track_id, asyncio.Lock())
        async with turn:
            for _ in range(_TRIES):
                work = partial(self._follow, track_id, reach, steps, flush)
                live, write, outcome = await loop.run_in_executor(self._pool, work)
                if write is None:
                    return outcome
                if await asyncio.wrap_future(self._log.write(write)):
                    self._keep(live)
                    return outcome
                self.forget(track_id)  # another process was faster, or has ended it: from its rows again
        raise Conflict(f"track {track_id} is followed by several clients at once; send its steps from one")

    def check_active(self, live: Live) -> None:
        """Raise Conflict for a track that takes no more steps."""
        if live.ended_reason is not None or self.is_idle(live.touched_at):
            raise _ended(live.track_id, live.ended_reason or "idle", self.idle_timeout_s)

    def live(self, track_id: str, reach: Reach) -> Live:
        """The track as it is stored, with its state. Raises NotFound."""
        with self._sessions() as session:
            stored = session.execute(
                select(Track.version, Track.organisation_id, Track.building_id).where(Track.id == track_id)
            ).one_or_none()
        if stored is None or not reach.holds(stored.organisation_id, stored.building_id):
            raise NotFound(f"no track {track_id}")
        with self._memory:
            held = self._live.get(track_id)
        return held if held is not None and held.version == stored.version else self._load(track_id, reach)

    def forget(self, track_id: str) -> None:
        """Drop a state from memory."""
        with self._memory:
            self._drop(track_id)

    def kind_of(self, track_id: str, reach: Reach) -> StepKind | None:
        """What the steps of a track are that is in memory; asks nobody."""
        with self._memory:
            live = self._live.get(track_id)
        return live.kind if live is not None and reach.holds(live.organisation_id, live.building_id) else None

    def now(self) -> datetime:
        return self._clock()

    def end_idle(self) -> int:
        """End every track that has been idle; how many they were."""
        with self._memory:
            for track_id in [each.track_id for each in self._live.values() if self.is_idle(each.touched_at)]:
                self._drop(track_id)
        with self._sessions.begin() as session:
            return end_idle(session, self.idle_before, self.now())

    def is_idle(self, touched_at: datetime) -> bool:
        return self._clock() - touched_at > timedelta(seconds=self.idle_timeout_s)

    @property
    def idle_before(self) -> datetime:
        """A track that was last touched before this has ended."""
        return self._clock() - timedelta(seconds=self.idle_timeout_s)

    def close(self) -> None:
        self._log.close()

    def _follow(
        self, track_id: str, reach: Reach, steps: Sequence[RawStep], flush: bool
    ) -> tuple[Live, Write | None, Outcome]:
        with self._memory:
            live = self._live.get(track_id)
        if live is None or not reach.holds(live.organisation_id, live.building_id):
            live = self._load(track_id, reach)
        self.check_active(live)
        arranged = arrange(steps, live.waiting, live.gaps, live.next_step, live.last, flush)
        if not arranged.ready and arranged.waiting == live.waiting:
            return live, None, _outcome(live, arranged)
        went, write = _go_on(live, arranged, self._clock())
        return went, write, _outcome(went, arranged)

    def _load(self, track_id: str, reach: Reach) -> Live:
        """From the database: the state that was kept last, and every batch after it once more."""
        with self._sessions() as session:
            kept = read_state(session, track_id)  # before the row, so that it is never ahead of it
            row = session.get(Track, track_id)
        if row is None or not reach.holds(row.organisation_id, row.building_id):
            raise NotFound(f"no track {track_id}")
        live = self._restored(row, kept)
        self._keep(live)
        return live

    def _restored(self, row: Track, kept: tuple[int, bytes] | None) -> Live:
        tracker = self.trackers.make(row.spec, row.frame, row.seed)
        kind = step_kind(row.spec, row.frame)
        batches, state = 0, begin()
        if kept is not None:
            try:
                batches, state = kept[0], state_from_bytes(kept[1])
            except CorruptArtefact:  # a cache that cannot be read is none
                batches, state = 0, begin()
        kept_step = 0
        estimate, last = SEARCHING, None
        # The last batch is read in any case: it says what was answered.
        for batch, _ in batches_of(self._sessions, row.id, max(min(batches, row.batches) - 1, 0), row.batches):
            if batch.sequence >= batches:
                state, _ = follow_steps(tracker, state, batch.steps, kind, batch.sequence, batch.next_step)
            else:
                kept_step = batch.next_step
            estimate, last = batch.estimate, batch.steps[-1]
        return Live(
            row.id, row.organisation_id, row.building_id, kind, tracker, state, row.version, row.batches,
            row.next_step, tuple(row.waiting), tuple((first, stop) for first, stop in row.gaps), last, estimate,
            kept_step, row.touched_at, row.ended_reason,
        )  # fmt: skip

    def _keep(self, live: Live) -> None:
        """Hold a state; drop what was used longest ago until all fits."""
        with self._memory:
            held = self._live.get(live.track_id)
            if held is not None and held.version > live.version:
                return
            self._drop(live.track_id)
            self._live[live.track_id] = live
            self._bytes += _nbytes(live)
            while self._bytes > self._capacity_bytes and len(self._live) > 1:
                self._drop(next(iter(self._live)))

    def _drop(self, track_id: str) -> None:
        live = self._live.pop(track_id, None)
        if live is not None:
            self._bytes -= _nbytes(live)


def _go_on(live: Live, arranged: Arranged, now: datetime) -> tuple[Live, Write]:
    """The track after a batch, and what is to be written of it."""
    state, estimate, batch = live.state, live.estimate, None
    if arranged.ready:
        state, batch = follow_steps(
            live.tracker, state, arranged.ready, live.kind, live.batches, arranged.next_step
        )  # fmt: skip
        estimate = batch.estimate
    keeps = arranged.next_step >= live.kept_step + STATE_EVERY
    went = replace(
        live, state=state, version=live.version + 1, batches=live.batches + (batch is not None),
        next_step=arranged.next_step, waiting=arranged.waiting, gaps=arranged.gaps,
        last=arranged.ready[-1] if arranged.ready else live.last, estimate=estimate,
        kept_step=arranged.next_step if keeps else live.kept_step, touched_at=now,
    )  # fmt: skip
    kept = state_to_bytes(state) if keeps else None
    write = Write(
        live.track_id, live.version, went.next_step, went.batches, went.waiting, went.gaps, batch, kept
    )  # fmt: skip
    return went, write


def _outcome(live: Live, arranged: Arranged) -> Outcome:
    return Outcome(
        live.track_id, live.next_step, arranged.accepted, arranged.duplicates, arranged.late, len(live.waiting),
        live.estimate,
    )  # fmt: skip


def _ended(track_id: str, reason: str, idle_timeout_s: float) -> Conflict:
    why = f"no step came for {idle_timeout_s:g} s" if reason == "idle" else "it was asked to end"
    return Conflict(f"track {track_id} has ended: {why}; its path can be read, go on with a new track")


def _nbytes(live: Live) -> int:
    return 20_000 + state_nbytes(live.state)
