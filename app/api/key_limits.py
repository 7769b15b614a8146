"""What one key may do: so many requests a second, so many at once, so many open streams.

Counted in this process alone: N processes behind one address let N times as much through. Everything here runs in the
event loop, and takes a few microseconds.
"""

from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import monotonic

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.errors import TooMany

__all__ = ["KeyLimits", "KeyLimitsMiddleware"]

BURST_S = 10.0
"""What a key did not use of the last seconds may come at once."""
_MOST_KEYS = 10_000
_IN_SCOPE = "isodyn.key"


@dataclass(slots=True)
class _Use:
    """Of one key: requests that are left, and as of when; requests and streams that are open."""

    left: float
    at: float
    requests: int = 0
    streams: int = 0


class KeyLimits:
    """`per_s` requests a second and key, sustained; `requests` and `streams` open at one time."""

    def __init__(self, per_s: float, requests: int, streams: int, clock: Callable[[], float] = monotonic) -> None:
        self._per_s, self._requests, self._streams, self._clock = per_s, requests, streams, clock
        self._full = max(per_s * BURST_S, 1.0)
        self._uses: OrderedDict[str, _Use] = OrderedDict()
        self._policy = f'"requests";q={self._full:.0f};w={BURST_S:.0f}'.encode()

    def begin(self, key_id: str, scope: Scope) -> None:
        """Count a request, which the middleware ends. Raises TooMany."""
        use = self._use(key_id)
        scope[_IN_SCOPE] = use  # before it is refused, so that the refusal says what is left
        use.requests += 1
        if use.requests > self._requests:
            reason = f"this key has {self._requests} requests open, the most at one time; wait for their answers"
            raise TooMany(reason, retry_after_s=1.0)
        self._take(use, 1.0)

    def take(self, key_id: str, requests: int) -> None:
        """Count more for a request that does as much as several. Raises TooMany."""
        self._take(self._use(key_id), min(requests, self._full))

    @contextmanager
    def stream(self, key_id: str) -> Iterator[None]:
        """Hold one of the key's streams. Raises TooMany."""
        use = self._use(key_id)
        if use.streams >= self._streams:
            raise TooMany(f"this key has {self._streams} streams open, the most; close one first", retry_after_s=5.0)
        use.streams += 1
        try:
            yield
        finally:
            use.streams -= 1

    def end(self, scope: Scope) -> None:
        """The request has been answered."""
        use = scope.pop(_IN_SCOPE, None)
        if use is not None:
            use.requests -= 1

    def headers(self, scope: Scope) -> list[tuple[bytes, bytes]]:
        """What is left of the rate, as the IETF's draft on RateLimit header fields has it; none without a key."""
        use = scope.get(_IN_SCOPE)
        if use is None:
            return []
        refill_s = (self._full - use.left) / self._per_s
        return [(b"ratelimit-policy", self._policy), (b"ratelimit", b'"requests";r=%d;t=%d' % (use.left, refill_s))]

    def _use(self, key_id: str) -> _Use:
        use = self._uses.get(key_id)
        if use is None:
            use = self._uses[key_id] = _Use(self._full, self._clock())
            if len(self._uses) > _MOST_KEYS:
                self._uses.popitem(last=False)
        else:
            self._uses.move_to_end(key_id)
        return use

    def _take(self, use: _Use, requests: float) -> None:
        now = self._clock()
        use.left = min(use.left + self._per_s * (now - use.at), self._full)
        use.at = now
        if use.left < requests:
            wait_s = (requests - use.left) / self._per_s
            raise TooMany(f"this key asks more than {self._per_s:g} times a second; slow down", retry_after_s=wait_s)
        use.left -= requests


class KeyLimitsMiddleware:
    """Ends what `KeyLimits.begin` counted, and tells what is left."""

    def __init__(self, app: ASGIApp, limits: KeyLimits) -> None:
        self.app, self.limits = app, limits

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def tell(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *self.limits.headers(scope)]
            await send(message)

        try:
            await self.app(scope, receive, tell)
        finally:
            self.limits.end(scope)
