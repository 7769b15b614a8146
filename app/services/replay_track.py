"""Follow all stored steps of a track again, from its seed on its maps, beside what was answered then."""

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import sha256

from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Track
from app.services.follow import follow_steps
from app.services.track_estimate import Told
from app.services.track_log import batches_of
from app.services.track_spec import Trackers, step_kind
from app.tracking.track import begin

__all__ = ["ReplayedBatch", "replay_track"]


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedBatch:
    """What a batch comes to now; `equal`: every bit of its estimate, path and smoothed places is as it was then.

    `sha256` is that of all batches so far, as they come to now.
    """

    estimate: Told
    steps: int
    equal: bool
    sha256: str


def replay_track(sessions: sessionmaker[Session], trackers: Trackers, track: Track) -> Iterator[ReplayedBatch]:
    """Batch after batch, up to where the track is now."""
    tracker = trackers.make(track.spec, track.frame, track.seed)
    kind = step_kind(track.spec, track.frame)
    state, chain = begin(), sha256()
    for stored, digest in batches_of(sessions, track.id, 0, track.batches):
        state, batch = follow_steps(
            tracker, state, stored.steps, kind, stored.sequence, stored.next_step
        )  # fmt: skip
        now = batch.digest()
        chain.update(now.encode())
        yield ReplayedBatch(batch.estimate, len(batch.steps), now == digest, chain.hexdigest())
