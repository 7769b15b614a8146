"""The API for the signed-in page: a request with the session's cookie goes on with the session's key.

The key never reaches the browser, and the API knows nothing of cookies: it sees a key, with the scopes it has.
"""

from http import HTTPStatus
from urllib.parse import quote

from starlette.datastructures import Headers
from starlette.requests import cookie_parser
from starlette.types import ASGIApp, Receive, Scope, Send

from app.viewer.requests import foreign_fetch, refusal, same_origin
from app.viewer.sessions import SignedIn

__all__ = ["ApiDoor"]

_SAFE = frozenset({"GET", "HEAD"})
_NOT_PASSED_ON = frozenset({b"cookie", b"authorization"})


class ApiDoor:
    """Mounted at `/v1` of the viewer. Only our own page's requests pass; changes need its Origin."""

    def __init__(self, api: ASGIApp, signed_in: SignedIn, cookie: str) -> None:
        self._api, self._signed_in, self._cookie = api, signed_in, cookie

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        headers = Headers(scope=scope)
        ours = not foreign_fetch(headers) and (scope["method"] in _SAFE or same_origin(headers))
        if not ours:
            await refusal(HTTPStatus.FORBIDDEN, "only this server's own page may ask here")(scope, receive, send)
            return
        session = await self._signed_in.find(cookie_parser(headers.get("cookie", "")).get(self._cookie))
        if session is None:
            await refusal(HTTPStatus.UNAUTHORIZED, "sign in again")(scope, receive, send)
            return
        await self._api(_with_key(scope, session.key), receive, send)


def _with_key(scope: Scope, key: str) -> Scope:
    """The request as a client of the API would send it: its path from `/v1` on, the key and no cookie."""
    path = scope["path"][scope["path"].index("/v1/") :]
    kept = [(name, value) for name, value in scope["headers"] if name not in _NOT_PASSED_ON]
    return {
        **{name: value for name, value in scope.items() if name not in ("app", "router", "endpoint", "route")},
        "root_path": "",
        "path": path,
        "raw_path": quote(path).encode(),
        "path_params": {},
        "headers": [*kept, (b"authorization", b"Bearer " + key.encode())],
    }
