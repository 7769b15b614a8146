"""What every answer tells a browser: believe the media type, frame and load nothing, keep answers to one's own key.

An answer that has a policy of its own (the page, the contract's page) keeps it.
"""

from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["NO_CONTENT_POLICY", "SecurityHeaders"]

NO_CONTENT_POLICY = "default-src 'none'; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
_ALWAYS = {
    b"x-content-type-options": b"nosniff",
    b"x-frame-options": b"DENY",
    b"referrer-policy": b"no-referrer",
    b"content-security-policy": NO_CONTENT_POLICY.encode(),
    b"cross-origin-opener-policy": b"same-origin",
    b"cross-origin-resource-policy": b"same-origin",
    b"permissions-policy": b"camera=(), microphone=(), geolocation=()",
}


class SecurityHeaders:
    """Adds the headers that an answer lacks. `hsts_s`: for how long a browser that came by TLS is to do so again."""

    def __init__(self, app: ASGIApp, hsts_s: int = 0) -> None:
        self.app = app
        self._hsts = (b"strict-transport-security", b"max-age=%d" % hsts_s) if hsts_s else None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return

        async def tell(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = list(message.get("headers", ()))
                there = {name.lower() for name, _ in headers}
                headers += [each for each in _ALWAYS.items() if each[0] not in there]
                if scope["path"].startswith("/v1/"):
                    headers.append((b"vary", b"Authorization"))
                    if b"cache-control" not in there:
                        headers.append((b"cache-control", b"private, no-cache"))
                if self._hsts is not None and scope.get("scheme") == "https":
                    headers.append(self._hsts)
                message["headers"] = headers
            await send(message)

        await self.app(scope, receive, tell)
