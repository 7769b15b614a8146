"""How fast steps may come: a bucket per track that fills at a rate, and holds a minute's worth."""

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from time import monotonic

__all__ = ["StepRate"]

_HELD_S = 60.0
_MOST_BUCKETS = 10_000


class StepRate:
    """`per_s` steps a second and track, sustained. After a break a client may send what it held back."""

    def __init__(self, per_s: float, clock: Callable[[], float] = monotonic) -> None:
        self._per_s, self._full, self._clock = per_s, per_s * _HELD_S, clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()  # what is left, and when
        self._lock = Lock()

    def take(self, track_id: str, steps: int) -> float:
        """Zero, and the steps are counted; or seconds until they may come, and they are not."""
        with self._lock:
            now = self._clock()
            left, then = self._buckets.pop(track_id, (self._full, now))
            left = min(left + self._per_s * (now - then), self._full)
            # A batch larger than the bucket passes when it is full: it could not pass at all otherwise.
            short = min(steps, self._full) - left
            self._buckets[track_id] = (left if short > 0.0 else left - steps, now)
            while len(self._buckets) > _MOST_BUCKETS:
                self._buckets.popitem(last=False)
            return max(short, 0.0) / self._per_s
