"""What limits, admission, tags and headers add to a request: the middlewares around an application that does nothing.

`python benchmarks/limits_overhead.py` prints microseconds a request, with and without them.
"""

import asyncio
import time
from typing import Any

from app.api.admission import Admission, BodyMemory
from app.api.body import BodyLimit
from app.api.entity_tags import EntityTags
from app.api.headers import SecurityHeaders
from app.api.key_limits import KeyLimits, KeyLimitsMiddleware

COUNT = 20_000
LIMITS = KeyLimits(1e9, 1000, 1000)


async def answer(scope: Any, receive: Any, send: Any) -> None:
    await receive()
    if "counted" in scope:
        LIMITS.begin("key", scope)
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-type", b"application/json")]})
    await send({"type": "http.response.body", "body": b"{}"})


async def microseconds(application: Any, **more: Any) -> float:
    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": b"x" * 500}

    async def send(message: Any) -> None:
        pass

    start = time.perf_counter()
    for _ in range(COUNT):
        scope = {"type": "http", "path": "/v1/buildings/x/locate", "method": "POST", "headers": [], **more}
        await application(scope, receive, send)
    return 1e6 * (time.perf_counter() - start) / COUNT


async def main() -> None:
    memory = BodyMemory(2**30, 1.0)
    body: Any = BodyLimit(answer, 2**20, memory, lambda path: False)
    limited: Any = Admission(KeyLimitsMiddleware(body, LIMITS), 500)
    whole: Any = SecurityHeaders(EntityTags(limited))
    bare = min([await microseconds(answer) for _ in range(5)])
    for name, application in (("the body's limits", body), ("and the key's", limited), ("and headers and tags", whole)):
        more = {} if application is body else {"counted": True}
        taken = min([await microseconds(application, **more) for _ in range(5)])
        print(f"{name:>22}: {taken - bare:5.1f} us a request more than nothing")


if __name__ == "__main__":
    asyncio.run(main())
