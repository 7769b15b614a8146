"""An OpenID Connect issuer on loopback: discovery, keys, and tokens signed with them."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import Any

from joserfc import jwt
from joserfc.jwk import ECKey, RSAKey

AUDIENCE = "isodyn"


class Issuer:
    """`answers` False: it is away. `fetched` are the paths that were asked for."""

    def __init__(self, url: str) -> None:
        self.url, self.answers, self.told_issuer = url, True, url
        self.fetched: list[str] = []
        self.keys: dict[str, Any] = {
            "rsa-1": RSAKey.generate_key(2048, {"kid": "rsa-1", "use": "sig"}),
            "ec-1": ECKey.generate_key("P-256", {"kid": "ec-1"}),
        }

    def claims(self, **more: Any) -> dict[str, Any]:
        """Those of a good token; None leaves a claim out."""
        now = int(time.time())
        told = {
            "iss": self.url, "aud": AUDIENCE, "sub": "anna", "iat": now, "exp": now + 300,
            "scope": "map:read locate", "isodyn_organisation": "default",
        }  # fmt: skip
        return {name: value for name, value in (told | more).items() if value is not None}

    def token(self, kid: str = "rsa-1", header: dict[str, Any] | None = None, key: Any = None, **more: Any) -> str:
        algorithm = "ES256" if kid.startswith("ec") else "RS256"
        told = {"alg": algorithm, "kid": kid} | (header or {})
        return jwt.encode(told, self.claims(**more), key or self.keys[kid], algorithms=[told["alg"]])

    def answer(self, path: str) -> dict[str, Any] | None:
        self.fetched.append(path)
        if not self.answers:
            return None
        if path == "/.well-known/openid-configuration":
            return {"issuer": self.told_issuer, "jwks_uri": f"{self.url}/keys"}
        if path == "/keys":
            return {"keys": [key.as_dict(private=False) for key in self.keys.values()]}
        return None


@contextmanager
def running() -> Iterator[Issuer]:
    """An issuer that serves until the block ends."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            told = issuer.answer(self.path)
            self.send_response(200 if told is not None else 503)
            self.end_headers()
            self.wfile.write(json.dumps(told).encode())

        def log_message(self, *_: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    issuer = Issuer(f"http://127.0.0.1:{server.server_port}")
    thread = Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield issuer
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
