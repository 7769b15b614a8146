"""Which workers live: each keeps a row beaten with the database's clock, and the living bury the dead.

A worker that cannot beat for the time to live must not go on, because somebody else may have been given its jobs: it
stops itself (`Lease.is_lost`). Taking over from a dead worker is a compare-and-set, so each has one heir at a time.
"""

import threading
import time
from collections.abc import Collection
from datetime import UTC, datetime

from sqlalchemy import ColumnElement, Engine, and_, delete, insert, literal_column, or_, update
from sqlalchemy.exc import SQLAlchemyError

from app.db.tables import Worker

__all__ = ["FRESH_BEAT_S", "Lease"]

FRESH_BEAT_S = 120.0
"""A worker whose beat is older does not live, for whoever looks by a clock of its own: four times the usual lease."""

LONG_AGO = datetime(2000, 1, 1, tzinfo=UTC)


class Lease:
    """The lease of this process, beaten from a thread of its own every quarter of the time to live."""

    def __init__(self, engine: Engine, worker_id: str, ttl_s: float, slots: int = 1) -> None:
        """`slots`: the jobs that this worker runs at one time."""
        self.worker_id, self.ttl_s, self._slots = worker_id, ttl_s, slots
        self._engine = engine
        self._fenced = False
        self._beaten_s = time.monotonic()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._beat_until_stopped, name="lease", daemon=True)

    def start(self) -> None:
        """Write the row and begin to beat."""
        row = insert(Worker).values(id=self.worker_id, state="live", beat=self._clock(), slots=self._slots)
        with self._engine.begin() as connection:
            connection.execute(row)
        self._beaten_s = time.monotonic()
        self._thread.start()

    @property
    def is_lost(self) -> bool:
        """Whether somebody declared this worker dead, or may have: no beat has succeeded for the time to live."""
        silent_s = time.monotonic() - self._beaten_s
        return not self._stopping.is_set() and (self._fenced or silent_s > self.ttl_s)

    def beat(self) -> bool:
        """Show that this worker lives. False: it was declared dead."""
        sent_s = time.monotonic()
        mine = update(Worker).where(Worker.id == self.worker_id, Worker.state == "live").values(beat=self._clock())
        with self._engine.begin() as connection:
            self._fenced = connection.execute(mine).rowcount == 0
        self._beaten_s = sent_s  # before the row was written: this clock runs out first
        return not self._fenced

    def release(self, *, unfinished: bool) -> None:
        """Stop beating. With jobs unfinished the row stays, dead and without an heir, to be taken over at once."""
        self._stopping.set()
        self._thread.join()
        mine = Worker.id == self.worker_id
        last = (
            update(Worker).where(mine).values(state="dead", beat=LONG_AGO) if unfinished else delete(Worker).where(mine)
        )
        with self._engine.begin() as connection:
            connection.execute(last)

    def take_over_from_dead(self, known_dead: Collection[str] = ()) -> list[str]:
        """Become the heir of every worker whose beat is too old or that is known to be dead, and return their ids.

        An heir that dies too before it calls `bury` leaves a dead row whose beat grows old again. A beat of the future
        is from before the clock was set back: whoever lives soon beats again.
        """
        dead = (
            update(Worker)
            .where(
                Worker.id != self.worker_id,
                or_(
                    Worker.beat < self._clock(-self.ttl_s),
                    Worker.beat > self._clock(self.ttl_s),
                    and_(Worker.state == "live", Worker.id.in_(known_dead)),
                ),
            )
            .values(state="dead", reaper=self.worker_id, beat=self._clock())
            .returning(Worker.id)
        )
        with self._engine.begin() as connection:
            return list(connection.scalars(dead))

    def bury(self, dead_id: str) -> None:
        """Forget a dead worker whose jobs have been handed over."""
        with self._engine.begin() as connection:
            connection.execute(delete(Worker).where(Worker.id == dead_id, Worker.reaper == self.worker_id))

    def _beat_until_stopped(self) -> None:
        while not self._stopping.wait(self.ttl_s / 4):
            try:
                if not self.beat():
                    return
            except SQLAlchemyError:  # the database is away or busy: `is_lost` decides when that has been too long
                continue

    def _clock(self, offset_s: float = 0.0) -> ColumnElement[datetime]:
        """The database's clock, in its own column format."""
        if self._engine.dialect.name == "sqlite":
            return literal_column(f"strftime('%Y-%m-%d %H:%M:%f000', 'now', '{offset_s:+.3f} seconds')")
        return literal_column(f"(clock_timestamp() + interval '{offset_s:.3f} seconds')")
