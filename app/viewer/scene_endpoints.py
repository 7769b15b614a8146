"""The canvas of a page and what it is asked: its frame, its WebSocket, and show, mark, pick and camera over HTTP.

A page names its view by a random id of its own; views are filed under the session, so that no other session can name
them.
"""

import asyncio
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import TypeVar

import httpx
from pydantic import BaseModel
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from app.errors import Conflict, IsodynError, NotFound, Overloaded
from app.services.reach import Reach
from app.viewer.asked import Marks, Shown, Target
from app.viewer.chosen import choose
from app.viewer.client_scene import ClientScene
from app.viewer.content import OrganisationContent
from app.viewer.proxy import CLOSE_FULL, CLOSE_SIGNED_OUT, PAGE_POLICY, ViserPage, fetch_page, relay
from app.viewer.requests import SECURITY_HEADERS, problem, read_json, refusal, same_origin
from app.viewer.sessions import Session, SignedIn
from app.viewer.viser_pool import ViserPool

__all__ = ["SceneEndpoints"]

_log = logging.getLogger(__name__)
_MOST_ASKED_BYTES = 2 * 2**20
_LOOKS_EVERY_S = 0.05
_VIEW = re.compile(r"[A-Za-z0-9_-]{8,64}")
Asked = TypeVar("Asked", bound=BaseModel)


class SceneEndpoints:
    """Routes below `/scene/{view}`."""

    def __init__(self, signed_in: SignedIn, pool: ViserPool, cookie: str, connects_within_s: float) -> None:
        self._signed_in, self._pool, self._cookie = signed_in, pool, cookie
        self._connects_within_s = connects_within_s
        self._page: ViserPage | None = None
        self._expected: set[asyncio.Task[ViserPage]] = set()

    def routes(self) -> list[BaseRoute]:
        return [
            Route("/scene/{view}", self._frame, methods=["GET"]),
            WebSocketRoute("/scene/{view}", self._connect),
            Route("/scene/{view}/show", self._asked(Shown, ClientScene.show, ahead=choose), methods=["POST"]),
            Route("/scene/{view}/mark", self._asked(Marks, ClientScene.mark), methods=["POST"]),
            Route("/scene/{view}/pick", self._asked(Target, ClientScene.pick), methods=["POST"]),
            Route("/scene/{view}/camera", self._camera, methods=["GET"]),
        ]

    async def _frame(self, request: Request) -> Response:
        """viser's canvas. Its client takes the address of any server from its query, so a query is dropped."""
        session = await self._session(request)
        if session is None:
            return refusal(HTTPStatus.UNAUTHORIZED, "sign in again")
        if _view(request.path_params["view"], session) is None:
            return refusal(HTTPStatus.NOT_FOUND, "a view is named by 8 to 64 letters and digits")
        if request.url.query:
            return RedirectResponse(request.url.path, HTTPStatus.SEE_OTHER, SECURITY_HEADERS)
        try:
            page = await self._ready(session.reach)
        except Overloaded as error:
            return problem(error)
        except httpx.TransportError:
            return refusal(HTTPStatus.SERVICE_UNAVAILABLE, "the viewer is starting again; load this page once more")
        return _page_response(page, request)

    def expect(self, reach: Reach) -> None:
        """Somebody of the organisation is about to look: begin to make ready, and wait for nobody."""
        task = asyncio.create_task(self._ready(reach))
        self._expected.add(task)
        task.add_done_callback(self._arrived)

    def _arrived(self, task: asyncio.Task[ViserPage]) -> None:
        self._expected.discard(task)
        if not task.cancelled() and not isinstance(task.exception(), Overloaded | None):  # its frame says so
            _log.warning("the viewer could not be made ready", exc_info=task.exception())

    async def _ready(self, reach: Reach) -> ViserPage:
        """The organisation's server started, and viser's page, which is the same for all. Raises TransportError,
        Overloaded."""
        async with self._pool.visit(reach) as viewer:
            try:
                if self._page is None:
                    self._page = await fetch_page(viewer.http_url)
            except httpx.TransportError:
                await self._pool.discard(reach, viewer)
                raise
        return self._page

    async def close(self) -> None:
        """Wait for what was begun."""
        await asyncio.gather(*self._expected, return_exceptions=True)

    async def _connect(self, websocket: WebSocket) -> None:
        """The canvas's WebSocket: foreign origins get 403 and nothing else; no session, a close with 4401; no room, one
        with 1013."""
        if not same_origin(websocket.headers):
            await websocket.close()  # before accepting: the handshake is answered with 403
            return
        session = await self._signed_in.find(websocket.cookies.get(self._cookie))
        view = None if session is None else _view(websocket.path_params["view"], session)
        if session is None or view is None:
            await websocket.accept()
            await websocket.close(CLOSE_SIGNED_OUT, "not signed in")
            return
        ended = asyncio.ensure_future(self._signed_in.until_ended(session))
        try:
            async with self._pool.visit(session.reach) as viewer:
                reached = await relay(websocket, viewer.websocket_url(view), ended)
            if not reached:
                await self._pool.discard(session.reach, viewer)
        except Overloaded:
            await websocket.accept()
            await websocket.close(CLOSE_FULL, "too many 3-D views are open; try again in a minute")
        finally:
            ended.cancel()

    def _asked(
        self,
        model: type[Asked],
        answer: Callable[[ClientScene, Asked], BaseModel | None],
        ahead: Callable[[OrganisationContent, Asked], object] | None = None,
    ) -> Callable[[Request], Awaitable[Response]]:
        """An endpoint that hands a checked body to the scene of its view, and the answer back.

        ahead: what can be made ready while the canvas is still connecting.
        """

        async def endpoint(request: Request) -> Response:
            if not same_origin(request.headers):
                return refusal(HTTPStatus.FORBIDDEN, "only this server's own page may ask here")
            try:
                asked = await read_json(request, model, _MOST_ASKED_BYTES)
                make_ready = None if ahead is None else lambda content: ahead(content, asked)
                async with self._scene(request, make_ready) as scene:
                    return _json(await run_in_threadpool(answer, scene, asked))
            except IsodynError as error:
                return problem(error)

        return endpoint

    async def _camera(self, request: Request) -> Response:
        try:
            async with self._scene(request) as scene:
                return _json(await run_in_threadpool(scene.camera))
        except IsodynError as error:
            return problem(error)

    @asynccontextmanager
    async def _scene(
        self, request: Request, make_ready: Callable[[OrganisationContent], object] | None = None
    ) -> AsyncIterator[ClientScene]:
        """The scene of the request's view, waiting for its canvas to connect. Raises NotFound, Conflict,
        Overloaded."""
        session = await self._session(request)
        view = None if session is None else _view(request.path_params["view"], session)
        if session is None or view is None:
            raise NotFound("there is no such view; sign in again")
        async with self._pool.visit(session.reach) as viewer:
            if make_ready is not None and view not in viewer.scenes:
                await run_in_threadpool(make_ready, viewer.content)
            for _ in range(int(self._connects_within_s / _LOOKS_EVERY_S)):
                if view in viewer.scenes:
                    yield viewer.scenes[view]
                    return
                await asyncio.sleep(_LOOKS_EVERY_S)
        raise Conflict("the canvas of this view is not connected; load the page again")

    async def _session(self, request: Request) -> Session | None:
        return await self._signed_in.find(request.cookies.get(self._cookie))


def _view(name: str, session: Session) -> str | None:
    """What a session's view is filed under; None for a name that is none."""
    return f"{session.name}.{name}" if _VIEW.fullmatch(name) else None


def _json(told: BaseModel | None) -> Response:
    if told is None:
        return Response(status_code=HTTPStatus.NO_CONTENT, headers=SECURITY_HEADERS)
    headers = {**SECURITY_HEADERS, "Cache-Control": "no-store"}
    return Response(told.model_dump_json(), headers=headers, media_type="application/json")


def _page_response(page: ViserPage, request: Request) -> Response:
    headers = {
        **SECURITY_HEADERS,
        "Content-Security-Policy": PAGE_POLICY,
        "Cache-Control": "private, no-cache",
        "ETag": page.etag,
        "Vary": "Cookie, Accept-Encoding",
    }
    if request.headers.get("if-none-match") == page.etag:
        return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        return HTMLResponse(page.gzipped, headers={**headers, "Content-Encoding": "gzip"})
    return HTMLResponse(page.html, headers=headers)
