"""The page `/view/`: sign in with an API key, then look at your organisation's floors, and work on them.

`ViewerApp` is an ASGI application to be mounted at `/view` in the API's own, so that the page shares its port and
origin. The page itself is plain HTML and JavaScript (`assets/live/`); in it is a frame with viser's canvas. It asks
`/view/scene/...` for what the canvas shows, and `/view/v1/...`, the API behind the session's key, for all else.
"""

import secrets
import time
from collections.abc import Callable, Mapping
from hashlib import sha256
from http import HTTPStatus
from importlib.resources import files
from urllib.parse import urlencode

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route, Router
from starlette.types import ASGIApp, Receive, Scope, Send

from app.errors import InvalidInput, TooLarge
from app.viewer.api_door import ApiDoor
from app.viewer.asked import ASKED_BY, Shown
from app.viewer.poster import poster_png
from app.viewer.requests import SECURITY_HEADERS, read_form, refusal, same_origin
from app.viewer.scene_endpoints import SceneEndpoints
from app.viewer.sessions import Session, SignedIn
from app.viewer.sign_in import LINK, SIGN_IN_POLICY, sign_in_html
from app.viewer.source import Authenticate, ViewerSource
from app.viewer.viser_pool import ViserPool

__all__ = ["COOKIE", "ViewerApp"]

COOKIE = "isodyn_view"
_MOST_FORM_BYTES = 4096
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_SHELL_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "frame-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)


class ViewerApp:
    """The viewer of one web process: sessions, viser servers and routes.

    authenticate       an API key to its identity, or None; called in a worker thread
    source             what can be shown, asked with the organisation of the signed-in key
    api                the application that answers `/v1/...`; without one the page can look, and change nothing
    session_seconds    how long a sign-in lasts
    idle_seconds       how long an organisation's viser server outlives its last visitor
    connect_seconds    how long a request waits for the canvas of its page

    Call `await close()` when the application stops.
    """

    def __init__(
        self,
        authenticate: Authenticate,
        source: ViewerSource,
        *,
        api: ASGIApp | None = None,
        session_seconds: float = 8 * 3600.0,
        idle_seconds: float = 600.0,
        connect_seconds: float = 15.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.signed_in = SignedIn(authenticate, session_seconds, clock)
        self.pool = ViserPool(source, idle_seconds, clock)
        self._source = source
        self._session_seconds = session_seconds
        self._assets = _read_assets()
        self._scenes = SceneEndpoints(self.signed_in, self.pool, COOKIE, connect_seconds)
        self._router = Router([*self._routes(), *self._scenes.routes()], redirect_slashes=False)
        if api is not None:
            self._router.mount("/v1", ApiDoor(api, self.signed_in, COOKIE))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._router(scope, receive, send)

    def _routes(self) -> list[BaseRoute]:
        return [
            Route("/", self._show, methods=["GET"]),
            Route("/session", self._sign_in, methods=["POST"]),
            Route("/session", self._session_state, methods=["GET"]),
            Route("/sign-out", self._sign_out, methods=["POST"]),
            Route("/assets/{name}", self._asset, methods=["GET"]),
            Route("/content", self._content, methods=["GET"]),
            Route("/poster.png", self._poster, methods=["GET"]),
        ]

    async def close(self) -> None:
        """End every session and stop every viser server."""
        self.signed_in.close_all()
        await self._scenes.close()
        await self.pool.close()

    async def _show(self, request: Request) -> Response:
        """The sign-in page, or the page itself, which reads what its address asks for."""
        if await self._session(request) is None:
            return _sign_in_page(request, _link(request.query_params))
        headers = {**SECURITY_HEADERS, "X-Frame-Options": "DENY", "Content-Security-Policy": _SHELL_POLICY,
                   "Cache-Control": "no-store", "Vary": "Cookie"}  # fmt: skip
        page = self._assets["page.html"][0].replace(b"VIEW", secrets.token_hex(12).encode())
        return HTMLResponse(page, headers=headers)

    async def _sign_in(self, request: Request) -> Response:
        """Take a key, give a cookie."""
        if not same_origin(request.headers):
            return refusal(HTTPStatus.FORBIDDEN, "sign in from this server's own page")
        try:
            form = await read_form(request, _MOST_FORM_BYTES)
        except TooLarge as error:
            return refusal(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, str(error))
        session = await self.signed_in.open(form.get("key", "").strip())
        if session is None:
            return _sign_in_page(request, _link(form), wrong_key=True)
        self._scenes.expect(session.reach)
        query = urlencode(_link(form))
        address = f"{_prefix(request)}/" + (f"?{query}" if query else "")
        response = RedirectResponse(address, HTTPStatus.SEE_OTHER, SECURITY_HEADERS)
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
        if not same_origin(request.headers):
            return refusal(HTTPStatus.FORBIDDEN, "sign out from this server's own page")
        session = await self._session(request)
        if session is not None:
            self.signed_in.close(session)
        response = RedirectResponse(f"{_prefix(request)}/", HTTPStatus.SEE_OTHER, SECURITY_HEADERS)
        response.delete_cookie(COOKIE, path=_prefix(request), httponly=True, samesite="strict")
        return response

    async def _asset(self, request: Request) -> Response:
        """A file of the page; there is nothing of anybody in them."""
        found = self._assets.get(request.path_params["name"])
        if found is None:
            return refusal(HTTPStatus.NOT_FOUND, "there is no such file")
        data, media_type, etag = found
        headers = {**SECURITY_HEADERS, "Cache-Control": "no-cache", "ETag": etag}
        if request.headers.get("if-none-match") == etag:
            return Response(status_code=HTTPStatus.NOT_MODIFIED, headers=headers)
        return Response(data, headers=headers, media_type=media_type)

    async def _content(self, request: Request) -> Response:
        """What the pickers offer: the organisation's buildings and floors, and what the key may do."""
        session = await self._session(request)
        if session is None:
            return refusal(HTTPStatus.UNAUTHORIZED, "sign in again")
        buildings = await run_in_threadpool(self._source.buildings, session.reach)
        shown = [
            {"id": b.id, "name": b.name,
             "floors": [{"id": f.id, "name": f.name, "ordinal": f.ordinal, "map_id": f.map_id} for f in b.floors]}
            for b in buildings
        ]  # fmt: skip
        return JSONResponse(
            {"scopes": sorted(session.scopes), "buildings": shown}, headers={"Cache-Control": "no-store"}
        )

    async def _poster(self, request: Request) -> Response:
        """What a deep link asks for, from above: the picture until the canvas has drawn. 204 without a map."""
        session = await self._session(request)
        if session is None:
            return refusal(HTTPStatus.UNAUTHORIZED, "sign in again")
        link = _link(request.query_params)
        try:
            asked = Shown.model_validate({ASKED_BY[name]: link[name] for name in ASKED_BY if name in link})
            png = await run_in_threadpool(poster_png, self.pool.content(session.reach), asked)
        except (ValueError, InvalidInput):
            png = None
        headers = {**SECURITY_HEADERS, "Cache-Control": "no-store"}
        if png is None:
            return Response(status_code=HTTPStatus.NO_CONTENT, headers=headers)
        return Response(png, headers=headers, media_type="image/png")

    async def _session(self, request: Request) -> Session | None:
        return await self.signed_in.find(request.cookies.get(COOKIE))


def _read_assets() -> dict[str, tuple[bytes, str, str]]:
    """The page's files with their media types and tags, by name."""
    read = {}
    for file in files("app.viewer").joinpath("assets/live").iterdir():
        suffix = file.name[file.name.rfind(".") :]
        if suffix in _TYPES:
            data = file.read_bytes()
            read[file.name] = (data, _TYPES[suffix], f'"{sha256(data).hexdigest()[:32]}"')
    return read


def _prefix(request: Request) -> str:
    """Where this application is mounted, without a slash at the end."""
    return str(request.scope.get("root_path", ""))


def _sign_in_page(request: Request, link: Mapping[str, str], wrong_key: bool = False) -> Response:
    headers = {**SECURITY_HEADERS, "X-Frame-Options": "DENY", "Content-Security-Policy": SIGN_IN_POLICY,
               "Cache-Control": "no-store"}  # fmt: skip
    status = HTTPStatus.UNAUTHORIZED if wrong_key else HTTPStatus.OK
    return HTMLResponse(sign_in_html(f"{_prefix(request)}/session", link, wrong_key), status, headers)


def _link(asked: Mapping[str, str]) -> dict[str, str]:
    """What a deep link may ask for, and nothing else of a query."""
    return {name: asked[name][:200] for name in LINK if asked.get(name)}
