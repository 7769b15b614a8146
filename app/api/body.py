"""Request bodies under limits: JSON bodies by a middleware, surveys and plans as they stream in, decompressed.

Every body has to come at `LEAST_BYTES_PER_S` at least, after `PATIENCE_S`: a client that sends a byte a minute holds
nothing for long. Bodies of all requests together have so much memory (`app.api.admission.BodyMemory`).
"""

import asyncio
import zlib
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager

import zstandard
from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.admission import BodyMemory
from app.api.problems import isodyn_problem
from app.errors import Fault, InvalidInput, IsodynError, TooLarge, TooSlow

__all__ = ["BodyLimit", "upload"]

PATIENCE_S = 20.0
LEAST_BYTES_PER_S = 4096
_UNCOUNTED_BYTES = 65_536  # of a small body: what the server itself reads ahead


class BodyLimit:
    """Refuse bodies above `max_bytes` with 413, on every path but uploads, which stream under their own limit."""

    def __init__(self, app: ASGIApp, max_bytes: int, memory: BodyMemory, streams_itself: Callable[[str], bool]) -> None:
        self.app, self.max_bytes, self.memory, self.streams_itself = app, max_bytes, memory, streams_itself

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or self.streams_itself(scope["path"]):
            await self.app(scope, receive, send)
            return
        body = _Body(self.max_bytes, self.memory)
        try:
            try:
                await body.read(receive)
            except IsodynError as error:
                await isodyn_problem(error)(scope, receive, send)
                return

            async def replay() -> Message:
                return body.messages.pop(0) if body.messages else await receive()

            await self.app(scope, replay, send)
        finally:
            self.memory.give(body.held)


class _Body:
    """A body as it comes: its messages, and the memory it holds."""

    def __init__(self, max_bytes: int, memory: BodyMemory) -> None:
        self.messages: list[Message] = []
        self.held = 0
        self._max_bytes, self._memory, self._size = max_bytes, memory, 0

    async def read(self, receive: Receive) -> None:
        """Raises TooLarge, TooSlow, Overloaded."""
        try:
            async with asyncio.timeout(PATIENCE_S) as timer:
                start = asyncio.get_running_loop().time() + PATIENCE_S
                while self._take(await receive()):
                    timer.reschedule(start + self._size / LEAST_BYTES_PER_S)
        except TimeoutError:
            raise _too_slow() from None

    def _take(self, message: Message) -> bool:
        """Whether more will come."""
        self.messages.append(message)
        self._size += len(message.get("body", b""))
        if self._size > self._max_bytes:
            raise TooLarge(f"the body is larger than {self._max_bytes:,} bytes")
        if self._size - self.held > _UNCOUNTED_BYTES:
            self._memory.take(self._size - self.held)
            self.held = self._size
        return message["type"] == "http.request" and bool(message.get("more_body", False))


@asynccontextmanager
async def upload(request: Request, max_bytes: int, memory: BodyMemory, organisation_id: str) -> AsyncIterator[bytes]:
    """The body of an organisation's upload, decompressed by its Content-Encoding (identity, gzip, zstd), which holds
    its memory until the block is left.

    Both the bytes sent and the bytes they unpack to are limited, so a small file that unpacks to a huge one is
    refused when it crosses the limit, not after. Raises TooLarge, TooSlow, InvalidInput (damaged or unknown encoding),
    and Overloaded and TooMany before anything is read.
    """
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding not in ("identity", "", *_UNPACK):
        raise InvalidInput(
            f"Content-Encoding {encoding[:40]!r} is not understood",
            Fault("/header/content-encoding", "send identity, gzip or zstd"),
        )
    said = request.headers.get("content-length", "")
    if said.isdigit() and int(said) > max_bytes:
        raise _too_large(max_bytes)
    async with AsyncExitStack() as held:
        plain = encoding not in _UNPACK
        await held.enter_async_context(
            memory.room(int(said) if said.isdigit() and plain else max_bytes, organisation_id)
        )
        data = await _collect(request.stream(), max_bytes)
        if plain and (encoding := _packed_as(data)) in _UNPACK:  # what it unpacks to may be far more than was said
            await held.aclose()
            await held.enter_async_context(memory.room(max_bytes, organisation_id))
        yield data if encoding not in _UNPACK else await run_in_threadpool(_UNPACK[encoding], data, max_bytes)


def _packed_as(data: bytes) -> str:
    """A packed file sent as it is, without saying so, is unpacked all the same."""
    magics = {"gzip": b"\x1f\x8b", "zstd": b"\x28\xb5\x2f\xfd"}
    return next((encoding for encoding, magic in magics.items() if data.startswith(magic)), "identity")


def _gunzip(packed: bytes, max_bytes: int) -> bytes:
    out = bytearray()
    try:
        while True:  # a file may have several members
            unzip = zlib.decompressobj(wbits=31)
            out += unzip.decompress(packed, max_bytes + 1 - len(out))
            _check(len(out), max_bytes)
            if not unzip.eof:
                raise _damaged("gzip", "the stream ends before its end mark")
            packed = unzip.unused_data
            if not packed:
                return bytes(out)
    except zlib.error as error:
        raise _damaged("gzip", str(error)) from error


def _unzstd(packed: bytes, max_bytes: int) -> bytes:
    out, frame, inside = bytearray(), None, False
    try:
        # Pieces bound the growth between checks: zstd packs at most about 1 : 20,000.
        for start in range(0, len(packed), 1024):
            piece = packed[start : start + 1024]
            while piece:  # a file may have several frames
                if frame is None:
                    frame = zstandard.ZstdDecompressor(max_window_size=2**27).decompressobj()
                out += frame.decompress(piece)
                _check(len(out), max_bytes)
                inside = not frame.eof
                piece = frame.unused_data if frame.eof else b""
                frame = None if frame.eof else frame
    except zstandard.ZstdError as error:
        raise _damaged("zstd", str(error)) from error
    if inside or not packed:
        raise _damaged("zstd", "the stream ends before its end mark")
    return bytes(out)


_UNPACK: dict[str, Callable[[bytes, int], bytes]] = {"gzip": _gunzip, "zstd": _unzstd}


async def _collect(chunks: AsyncIterator[bytes], max_bytes: int) -> bytes:
    """Raises TooLarge, TooSlow."""
    out = bytearray()
    try:
        async with asyncio.timeout(PATIENCE_S) as timer:
            start = asyncio.get_running_loop().time() + PATIENCE_S
            async for chunk in chunks:
                out += chunk
                _check(len(out), max_bytes)
                timer.reschedule(start + len(out) / LEAST_BYTES_PER_S)
    except TimeoutError:
        raise _too_slow() from None
    return bytes(out)


def _check(size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise _too_large(max_bytes)


def _too_large(max_bytes: int) -> TooLarge:
    return TooLarge(f"the body unpacks to more than {max_bytes:,} bytes; split a survey into several walks")


def _too_slow() -> TooSlow:
    return TooSlow(f"the body came more slowly than {LEAST_BYTES_PER_S:,} bytes a second; send it again")


def _damaged(encoding: str, why: str) -> InvalidInput:
    return InvalidInput(
        f"the {encoding} stream is damaged: {why}", Fault("/body", "send the file again, or without Content-Encoding")
    )
