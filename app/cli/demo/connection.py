"""The demonstration's way to its server: HTTP with a key, and refusals as plain sentences."""

from types import TracebackType
from typing import Any, Self

import httpx

from app.cli.demo.server import DemoError, DemoServer

__all__ = ["Connection"]

TIMEOUT_S = 300.0


class Connection:
    """One HTTP client, closed at the end of its `with`."""

    def __init__(self, server: DemoServer) -> None:
        self._server = server
        self._http = httpx.Client(
            base_url=server.url, headers={"Authorization": f"Bearer {server.key}"}, timeout=TIMEOUT_S
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._http.close()

    def call(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        """The response of one request. Raises DemoError for a refusal, with the server's reasons, or no answer."""
        try:
            response = self._http.request(method, path, **arguments)
        except httpx.TransportError as error:
            raise DemoError(f"{method} {path}: no answer ({error}); see {self._server.log}") from error
        if response.is_error:
            raise DemoError(f"{method} {path}: {response.status_code}, {_sentence(response)}; see {self._server.log}")
        return response


def _sentence(response: httpx.Response) -> str:
    """What a problem document says, or the bare body."""
    try:
        problem = response.json()
        faults = (f"{fault['location']}: {fault['reason']}" for fault in problem.get("errors", []))
        return "; ".join([str(problem["detail"]), *faults])
    except (ValueError, KeyError, TypeError):
        return response.text[:300]
