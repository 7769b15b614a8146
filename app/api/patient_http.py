"""HTTP as uvicorn speaks it, for a while: a client that does not finish its headers, or takes nothing of its answer, is
hung up on."""

import socket
from asyncio import TimerHandle, Transport
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

__all__ = ["PatientHttp"]

HEADERS_S = 20.0
"""From the opening of a connection, or the first byte of a later request, until the end of the headers."""
MOST_HEADER_BYTES = 65_536
ANSWER_S = 60.0
"""An answer, or what comes over a WebSocket, waits so long for its client to take any of it."""


class PatientHttp(HttpToolsProtocol):
    """Headers have `HEADERS_S` and `MOST_HEADER_BYTES`, answers `ANSWER_S`. Bodies are timed where they are read
    (`app.api.body`)."""

    _hang_up: TimerHandle | None = None
    _header_bytes = 0

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        # By the kernel, which also sees what is still to be sent when the connection was closed here, or upgraded.
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux has it
            connection: socket.socket = transport.get_extra_info("socket")
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, int(1e3 * ANSWER_S))
        self._expect_headers()

    def on_message_begin(self) -> None:
        super().on_message_begin()
        if self._hang_up is None:
            self._expect_headers()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self._hang_up is not None:
            self._header_bytes += len(data)
            if self._header_bytes > MOST_HEADER_BYTES:
                self.transport.close()

    def on_headers_complete(self) -> None:
        self._stop_waiting()
        super().on_headers_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def shutdown(self) -> None:
        self._stop_waiting()
        super().shutdown()

    def _expect_headers(self) -> None:
        self._header_bytes = 0
        self._hang_up = self.loop.call_later(HEADERS_S, self._close)

    def _stop_waiting(self) -> None:
        if self._hang_up is not None:
            self._hang_up.cancel()
            self._hang_up = None

    def _close(self, *_: Any) -> None:
        self._hang_up = None
        self.transport.close()
