"""The page `/view/`: sign in with an API key, then look at your organisation's floors in 3-D.

`ViewerApp` is an ASGI application to be mounted at `/view` in the API's own, so that the page shares its port and
origin. A signed-in browser is served viser's client under a path that names what it looks at
(`/view/buildings/ID/floors/ID`), because that client opens its WebSocket at the very path it was loaded from.
"""

import asyncio
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from urllib.parse import parse_qs, quote, urlsplit

import httpx
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route, Router, WebSocketRoute
from starlette.types import Receive, Scope, Send
from starlette.websockets import WebSocket

from app.viewer.client_view import Link
from app.viewer.proxy import CLOSE_SIGNED_OUT, PAGE_POLICY, ViserPage, fetch_page, relay
from app.viewer.sessions import Session, SignedIn
from app.viewer.sign_in import SIGN_IN_POLICY, sign_in_html
from app.viewer.source import Authenticate, ViewerSource
from app.viewer.viser_pool import ViserPool

__all__ = ["COOKIE", "ViewerApp"]

COOKIE = "isodyn_view"
_MOST_FORM_BYTES = 4096
_SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",  # "no-referrer" would make forms send the Origin "null"
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}


class ViewerApp:
    """The viewer of one web process: sessions, viser servers and routes.

    authenticate       an API key to its identity, or None; called in a worker thread
    source             what can be shown, asked with the organisation of the signed-in key
    session_seconds    how long a sign-in lasts
    idle_seconds       how long an organisation's viser server outlives its last visitor

    Call `await close()` when the application stops.
    """

    def __init__(
        self,
        authenticate: Authenticate,
        source: ViewerSource,
        *,
        session_seconds: float = 8 * 3600.0,
        idle_seconds: float = 600.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.signed_in = SignedIn(authenticate, session_seconds, clock)
        self.pool = ViserPool(source, idle_seconds, clock)
        self._session_seconds = session_seconds
        self._page: ViserPage | None = None
        self._router = Router(self._routes(), redirect_slashes=False)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._router(scope, receive, send)

    def _routes(self) -> list[BaseRoute]:
        # Not "/" for the page: viser's client drops the slash at the end of its own address, and a WebSocket at the
        # very prefix of a mounted application never reaches it.
        pages = ("/buildings", "/buildings/{building}", "/buildings/{building}/floors/{floor}")
        return [
            Route("/", self._show, methods=["GET"]),
            Route("/session", self._sign_in, methods=["POST"]),
            Route("/session", self._session_state, methods=["GET"]),
            Route("/sign-out", self._sign_out, methods=["POST"]),
            *(Route(page, self._show, methods=["GET"]) for page in pages),
            *(WebSocketRoute(page, self._connect) for page in pages),
        ]

    async def close(self) -> None:
        """End every session and stop every viser server."""
        self.signed_in.close_all()
        await self.pool.close()

    async def _show(self, request: Request) -> Response:
        """The sign-in page, or the page itself; what a query asks for moves into the path."""
        link = _link(request.path_params, request.query_params)
        session = await self._session(request)
        if session is None:
            return _sign_in_page(request, link)
        address = _address(request, link)
        if request.query_params or request.url.path != address:
            return RedirectResponse(address, HTTPStatus.SEE_OTHER)
        async with self.pool.visit(session.organisation_id) as viewer:
            try:
                if self._page is None:  # the same for every organisation
                    self._page = await fetch_page(viewer.http_url, _prefix(request))
            except httpx.TransportError:
                await self.pool.discard(session.organisation_id, viewer)
                return _refusal(
                    HTTPStatus.SERVICE_UNAVAILABLE, "the viewer is starting again; load this page once more"
                )
        return _page_response(self._page, request)

    async def _sign_in(self, request: Request) -> Response:
        """Take a key, give a cookie."""
        if not _same_origin(request.headers):
            return _refusal(HTTPStatus.FORBIDDEN, "sign in from this server's own page")
        form = await _form(request)
        if form is None:
            return _refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "the form is too large")
        link = _link({}, form)
        session = await self.signed_in.open(form.get("key", "").strip())
        if session is None:
            return _sign_in_page(request, link, wrong_key=True)
        response = RedirectResponse(_address(request, link), HTTPStatus.SEE_OTHER, _SECURITY_HEADERS)
        response.set_cookie(
            COOKIE,
            session.id,
            max_age=int(self._session_seconds),
            path=_prefix(request),
            httponly=True,
            samesite="strict",
            secure=request.url.scheme == "https",
        )
        return response

    async def _session_state(self, request: Request) -> Response:
        """204 while signed in, 401 afterwards: the open page asks, to know when to show the sign-in page again."""
        signed_in = await self._session(request) is not None
        return Response(
            status_code=HTTPStatus.NO_CONTENT if signed_in else HTTPStatus.UNAUTHORIZED,
            headers={"Cache-Control": "no-store"},
        )

    async def _sign_out(self, request: Request) -> Response:
        if not _same_origin(request.headers):
            return _refusal(HTTPStatus.FORBIDDEN, "sign out from this server's own page")
        session = await self._session(request)
        if session is not None:
            self.signed_in.close(session)
        response = RedirectResponse(f"{_prefix(request)}/", HTTPStatus.SEE_OTHER, _SECURITY_HEADERS)
        response.delete_cookie(COOKIE, path=_prefix(request), httponly=True, samesite="strict")
        return response

    async def _connect(self, websocket: WebSocket) -> None:
        """A page's WebSocket: foreign origins get 403 and nothing else; no session, a close with 4401."""
        if not _same_origin(websocket.headers):
            await websocket.close()  # before accepting: the handshake is answered with 403
            return
        session = await self.signed_in.find(websocket.cookies.get(COOKIE))
        if session is None:
            await websocket.accept()
            await websocket.close(CLOSE_SIGNED_OUT, "not signed in")
            return
        ended = asyncio.ensure_future(self.signed_in.until_ended(session))
        try:
            async with self.pool.visit(session.organisation_id) as viewer:
                reached = await relay(websocket, viewer.websocket_url(_link(websocket.path_params, {})), ended)
            if not reached:
                await self.pool.discard(session.organisation_id, viewer)
        finally:
            ended.cancel()

    async def _session(self, request: Request) -> Session | None:
        return await self.signed_in.find(request.cookies.get(COOKIE))


def _prefix(request: Request) -> str:
    """Where this application is mounted, without a slash at the end."""
    return str(request.scope.get("root_path", ""))


def _address(request: Request, link: Link) -> str:
    """The page's own path for a link."""
    address = f"{_prefix(request)}/buildings"
    if link.building_id is not None:
        address += f"/{quote(link.building_id, safe='')}"
        if link.floor_id is not None:
            address += f"/floors/{quote(link.floor_id, safe='')}"
    return address


def _sign_in_page(request: Request, link: Link, wrong_key: bool = False) -> Response:
    headers = {**_SECURITY_HEADERS, "Content-Security-Policy": SIGN_IN_POLICY, "Cache-Control": "no-store"}
    status = HTTPStatus.UNAUTHORIZED if wrong_key else HTTPStatus.OK
    return HTMLResponse(sign_in_html(f"{_prefix(request)}/session", link, wrong_key), status, headers)


def _link(path: Mapping[str, str], query: Mapping[str, str]) -> Link:
    def asked(name: str) -> str | None:
        return (path.get(name) or query.get(name) or "")[:100] or None

    return Link(asked("building"), asked("floor"))


def _same_origin(headers: Mapping[str, str]) -> bool:
    """Whether the page that asks is this server's: its Origin names the host that was asked. None given is a no."""
    origin, host = headers.get("origin", ""), headers.get("host", "")
    parts = urlsplit(origin)
    return parts.scheme in ("http", "https") and host != "" and parts.netloc.lower() == host.lower()


async def _form(request: Request) -> dict[str, str] | None:
    """The fields of a small form, None when it is larger than any sign-in."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > _MOST_FORM_BYTES:
            return None
    return {name: values[0] for name, values in parse_qs(body.decode("utf-8", "replace")).items()}


def _page_response(page: ViserPage, request: Request) -> Response:
    headers = {
        **_SECURITY_HEADERS,
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


def _refusal(status: HTTPStatus, reason: str) -> Response:
    return Response(f"{reason}\n", status, _SECURITY_HEADERS, media_type="text/plain")
