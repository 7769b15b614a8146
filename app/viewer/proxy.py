"""Between a signed-in browser and its organisation's viser server: the canvas over HTTP, messages over WebSocket.

viser trusts whoever connects. Here only where the camera is passes towards it; the rest (asking for a public share
address, setting controls, uploads, answers to questions nobody asked) is dropped. Cookies never travel on. The page is
served with a policy that lets it talk to its own origin only, because viser's client would connect to any address in
its URL.
"""

import asyncio
import contextlib
import gzip
import hashlib
import logging
from collections.abc import Sequence
from dataclasses import dataclass

import httpx
import msgspec
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.typing import Subprotocol

__all__ = [
    "CLOSE_FULL",
    "CLOSE_SIGNED_OUT",
    "CLOSE_UNREACHABLE",
    "PAGE_POLICY",
    "ViserPage",
    "fetch_page",
    "passes",
    "relay",
]

_log = logging.getLogger(__name__)

CLOSE_SIGNED_OUT = 4401
CLOSE_UNREACHABLE = 1011
CLOSE_FULL = 1013
_MOST_MESSAGE_BYTES = 64 * 2**10  # of a message from the browser: a camera or a control is far smaller
_MOST_SCENE_BYTES = 64 * 2**20

# The page's controls are not viser's: they ask over HTTP. viser itself is told where the camera is, and nothing else.
_PASSING = frozenset({"ViewerCameraMessage"})
# viser makes a client's scene once it knows of a camera. The browser tells its own a second or so after it connects,
# when it has drawn for the first time; until then this one stands in, so that the scene is on its way already.
_SOME_CAMERA = msgspec.msgpack.encode({
    "type": "ViewerCameraMessage", "wxyz": [0.0, 1.0, 0.0, 0.0], "position": [0.0, 0.0, 10.0], "fov": 1.309,
    "near": 0.01, "far": 1000.0, "image_height": 720, "image_width": 900, "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0],
})  # fmt: skip

PAGE_POLICY = (
    "default-src 'none'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src data:; connect-src 'self' data: blob:; worker-src blob: data:; "
    "form-action 'none'; base-uri 'none'; frame-ancestors 'self'"
)

# viser's own panels, notices and keyboard help have nothing to say here; its canvas fills the frame.
_ONLY_THE_CANVAS = (
    "<style>[data-dock-root]>:not(:first-child),.mantine-Notifications-root,.mantine-Paper-root,"
    "[data-mantine-shared-portal-node]{display:none!important}body{background:#1b1d22}</style>"
)


@dataclass(frozen=True, slots=True)
class ViserPage:
    """viser's single page, made ours: its bytes, plain and compressed, and their tag."""

    html: bytes
    gzipped: bytes
    etag: str


async def fetch_page(http_url: str) -> ViserPage:
    """Fetch viser's page from its server and leave only its canvas to be seen."""
    async with httpx.AsyncClient(trust_env=False) as client:
        answer = await client.get(http_url, headers={"Accept-Encoding": "identity"})
        answer.raise_for_status()
    page = answer.text.replace("<title>Viser</title>", "<title>Isodyn scene</title>", 1)
    html = page.replace("</head>", f"{_ONLY_THE_CANVAS}</head>", 1)
    data = html.encode()
    return ViserPage(data, gzip.compress(data, 6, mtime=0), f'"{hashlib.sha256(data).hexdigest()[:32]}"')


def passes(message: bytes) -> bool:
    """Whether a browser's message may go on to viser: small, readable, and about the camera."""
    if len(message) > _MOST_MESSAGE_BYTES:
        return False
    try:
        decoded = msgspec.msgpack.decode(message)
    except (msgspec.DecodeError, RecursionError):
        return False
    return isinstance(decoded, dict) and decoded.get("type") in _PASSING


async def relay(browser: WebSocket, upstream_url: str, ended: asyncio.Future[None]) -> bool:
    """Accept a browser and pass messages both ways until either side closes or `ended` is done (signed out).

    Sending waits for the receiver, so a slow browser slows its own stream only. Returns False when viser could not be
    reached; the browser is then told to try again.
    """
    offered = [Subprotocol(p) for p in browser.scope.get("subprotocols", ()) if p.startswith("viser-v")]
    try:
        upstream = await _connect(upstream_url, offered)
    except (OSError, WebSocketException, TimeoutError):
        await browser.accept()
        await browser.close(CLOSE_UNREACHABLE, "the viewer is not running; it is being started again")
        return False
    async with upstream:
        await browser.accept(subprotocol=upstream.subprotocol)
        await upstream.send(_SOME_CAMERA)
        towards_viser = asyncio.create_task(_towards_viser(browser, upstream))
        towards_browser = asyncio.create_task(_towards_browser(upstream, browser))
        flows = (towards_viser, towards_browser)
        try:
            await asyncio.wait([*flows, ended], return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in flows:
                task.cancel()
            for outcome in await asyncio.gather(*flows, return_exceptions=True):
                if isinstance(outcome, Exception):
                    _log.warning("a viewer connection broke", exc_info=outcome)
        await _close_browser(browser, upstream, signed_out=ended.done())
    return True


async def _connect(url: str, subprotocols: Sequence[Subprotocol]) -> ClientConnection:
    return await connect(
        url,
        subprotocols=subprotocols or None,
        compression=None,
        max_size=_MOST_SCENE_BYTES,
        proxy=None,  # never by a proxy from the environment: this is loopback
        user_agent_header=None,
        open_timeout=5,
        close_timeout=2,
    )


async def _towards_viser(browser: WebSocket, upstream: ClientConnection) -> None:
    with contextlib.suppress(WebSocketDisconnect, ConnectionClosed):
        while True:
            message = await browser.receive()
            if message["type"] == "websocket.disconnect":
                return
            data = message.get("bytes")
            if data is not None and passes(data):
                await upstream.send(data)


async def _towards_browser(upstream: ClientConnection, browser: WebSocket) -> None:
    with contextlib.suppress(WebSocketDisconnect, ConnectionClosed):
        async for message in upstream:
            if isinstance(message, bytes):
                await browser.send_bytes(message)


async def _close_browser(browser: WebSocket, upstream: ClientConnection, signed_out: bool) -> None:
    code, reason = 1000, ""
    if signed_out:
        code, reason = CLOSE_SIGNED_OUT, "signed out"
    elif upstream.close_code is not None:
        sendable = upstream.close_code in (1000, 1001, 1002, 1003, 1007, 1008, 1009, 1011)
        code, reason = (upstream.close_code if sendable else CLOSE_UNREACHABLE), upstream.close_reason or ""
    with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # it may have gone already
        await browser.close(code, reason)
