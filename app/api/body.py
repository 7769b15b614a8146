"""Request bodies under a limit: JSON bodies by a middleware, surveys and plans as they stream in, decompressed."""

import zlib
from collections.abc import AsyncIterator, Callable

import zstandard
from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.problems import isodyn_problem
from app.errors import Fault, InvalidInput, TooLarge

__all__ = ["BodyLimit", "read_upload"]


class BodyLimit:
    """Refuse bodies above `max_bytes` with 413, on every path but uploads, which stream under their own limit."""

    def __init__(self, app: ASGIApp, max_bytes: int, streams_itself: Callable[[str], bool]) -> None:
        self.app, self.max_bytes, self.streams_itself = app, max_bytes, streams_itself

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or self.streams_itself(scope["path"]):
            await self.app(scope, receive, send)
            return
        messages: list[Message] = []
        size = 0
        while True:
            message = await receive()
            messages.append(message)
            size += len(message.get("body", b""))
            if size > self.max_bytes:
                error = TooLarge(f"the body is larger than {self.max_bytes:,} bytes")
                await isodyn_problem(error)(scope, receive, send)
                return
            if message["type"] != "http.request" or not message.get("more_body", False):
                break

        async def replay() -> Message:
            return messages.pop(0) if messages else await receive()

        await self.app(scope, replay, send)


async def read_upload(request: Request, max_bytes: int) -> bytes:
    """The body of an upload, decompressed by its Content-Encoding (identity, gzip, zstd).

    Both the bytes sent and the bytes they unpack to are limited, so a small file that unpacks to a huge one is
    refused when it crosses the limit, not after. Raises TooLarge, InvalidInput (damaged or unknown encoding).
    """
    encoding = request.headers.get("content-encoding", "identity").strip().lower()
    if encoding in ("identity", ""):
        return _unpack_by_magic(await _collect(request.stream(), max_bytes), max_bytes)
    if encoding in _UNPACK:
        return _UNPACK[encoding](await _collect(request.stream(), max_bytes), max_bytes)
    raise InvalidInput(
        f"Content-Encoding {encoding[:40]!r} is not understood",
        Fault("/header/content-encoding", "send identity, gzip or zstd"),
    )


def _unpack_by_magic(data: bytes, max_bytes: int) -> bytes:
    """A packed file sent as it is, without saying so, is unpacked all the same."""
    for magic, encoding in ((b"\x1f\x8b", "gzip"), (b"\x28\xb5\x2f\xfd", "zstd")):
        if data.startswith(magic):
            return _UNPACK[encoding](data, max_bytes)
    return data


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
    out = bytearray()
    async for chunk in chunks:
        out += chunk
        _check(len(out), max_bytes)
    return bytes(out)


def _check(size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise TooLarge(f"the body unpacks to more than {max_bytes:,} bytes; split a survey into several walks")


def _damaged(encoding: str, why: str) -> InvalidInput:
    return InvalidInput(
        f"the {encoding} stream is damaged: {why}", Fault("/body", "send the file again, or without Content-Encoding")
    )
