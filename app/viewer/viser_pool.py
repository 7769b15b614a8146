"""One viser server per organisation, started by its first visitor and stopped when nobody has looked for a while; keys
that are limited to the same buildings share one of their own. There are so many at one time: for another, the one that
nobody has looked at for longest is stopped before its time.

Isolation is by construction: a server is made with the content within that reach only. Nothing is put
into a server's shared scene; a connection that does not bring the server's secret in its path (any other program on
this machine) gets an empty page.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlencode, urlsplit

import numpy as np
from starlette.concurrency import run_in_threadpool

from app.errors import Overloaded
from app.services.reach import Reach
from app.viewer.client_scene import ClientScene
from app.viewer.content import OrganisationContent, RecentlyUsed
from app.viewer.layers import ColourScale
from app.viewer.source import ViewerSource
from app.viewer.viser_server import LOOPBACK, start_viser, stop_viser

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

__all__ = ["OrganisationViewer", "ViserPool"]

_log = logging.getLogger(__name__)
_RECENT_BYTES = 384 * 2**20
_MOST_SERVERS, _MOST_OF_ONE = 100, 20  # each has a thread, a port and what its scenes hold
_MOST_LEFT = 50  # of the views that nobody looks at any more, in case somebody comes back


@dataclass(slots=True, eq=False)
class OrganisationViewer:
    """The viser server of one organisation and the browsers looking at it.

    scenes  the scene of each view; a view that connects again gets another, which shows what the last one showed
    """

    server: ViserServer
    content: OrganisationContent
    secret: str
    visitors: int = 0
    idle_since: float = 0.0
    scenes: OrderedDict[str, ClientScene] = field(default_factory=OrderedDict)

    @property
    def http_url(self) -> str:
        return f"http://{LOOPBACK}:{self.server.get_port()}/"

    def websocket_url(self, view: str) -> str:
        """Where the proxy connects for a browser's view."""
        return f"ws://{LOOPBACK}:{self.server.get_port()}/?{urlencode({'secret': self.secret, 'view': view})}"

    def welcome(self, client: ClientHandle) -> None:
        """Give a client that came by the proxy its scene; any other sees nothing."""
        view = self._view_of(client)
        if view is None:
            return
        scene = ClientScene(client, self.content)
        before = self.scenes.get(view)
        self.scenes[view] = scene
        self.scenes.move_to_end(view)
        left = [name for name, each in self.scenes.items() if each.has_left]
        for name in left[:-_MOST_LEFT]:
            del self.scenes[name]
        if before is not None:
            scene.resume(before)

    def farewell(self, client: ClientHandle) -> None:
        """Let go of what a client's scene holds; what it showed is remembered in case it comes back."""
        for scene in list(self.scenes.values()):
            if scene.belongs_to(client):
                scene.clear()

    def _view_of(self, client: ClientHandle) -> str | None:
        """The view in the path the proxy connected with; None for a connection that did not come by the proxy."""
        # viser 1.1 keeps no public record of a connection's request; the version is pinned and a test covers this.
        connection = self.server._websock_server._live_connections.get(client.client_id)
        if connection is None or connection.request is None:
            return None
        asked = parse_qs(urlsplit(connection.request.path).query)
        if not secrets.compare_digest(asked.get("secret", [""])[0], self.secret):
            return None
        return asked.get("view", [None])[0]


class ViserPool:
    """The servers by reach. `clock` counts seconds and never goes back."""

    def __init__(
        self, source: ViewerSource, idle_seconds: float = 600.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._source = source
        self._idle_seconds = idle_seconds
        self._clock = clock
        self._recent = RecentlyUsed(_RECENT_BYTES)
        self._viewers: dict[Reach, OrganisationViewer] = {}
        self._lock = asyncio.Lock()
        self._sweeper: asyncio.Task[None] | None = None

    def content(self, reach: Reach) -> OrganisationContent:
        """What the organisation's viewer can reach, whether its server runs or not."""
        return OrganisationContent(reach, self._source, self._recent)

    def running(self) -> dict[Reach, OrganisationViewer]:
        """The servers running now."""
        return dict(self._viewers)

    @contextlib.asynccontextmanager
    async def visit(self, reach: Reach) -> AsyncIterator[OrganisationViewer]:
        """The organisation's server, started if need be, and kept while the visit lasts. Raises Overloaded when there
        are as many as there may be, and somebody looks at each."""
        async with self._lock:
            viewer = self._viewers.get(reach)
            if viewer is None:
                await self._make_room(reach.organisation_id)
                viewer = await run_in_threadpool(self._start, reach)
                self._viewers[reach] = viewer
            if self._sweeper is None:
                self._sweeper = asyncio.create_task(self._sweep())
            viewer.visitors += 1
        try:
            yield viewer
        finally:
            viewer.visitors -= 1
            viewer.idle_since = self._clock()

    async def discard(self, reach: Reach, viewer: OrganisationViewer) -> None:
        """Stop a server that no longer answers; the next visit starts another."""
        async with self._lock:
            if self._viewers.get(reach) is viewer:
                del self._viewers[reach]
                await run_in_threadpool(stop_viser, viewer.server)

    async def stop_idle(self) -> None:
        """Stop every server that nobody has looked at for `idle_seconds`."""
        async with self._lock:
            now = self._clock()
            for reach, viewer in list(self._viewers.items()):
                if viewer.visitors == 0 and now - viewer.idle_since >= self._idle_seconds:
                    del self._viewers[reach]
                    await run_in_threadpool(stop_viser, viewer.server)

    async def _make_room(self, organisation_id: str) -> None:
        """Stop the server that nobody has looked at for longest, where one more would be too many."""
        own = [reach for reach in self._viewers if reach.organisation_id == organisation_id]
        if len(own) >= _MOST_OF_ONE:
            candidates, told = own, f"{_MOST_OF_ONE} 3-D views of sets of buildings of this organisation"
        elif len(self._viewers) >= _MOST_SERVERS:
            candidates, told = list(self._viewers), f"{_MOST_SERVERS} 3-D views of others"
        else:
            return
        idle = [reach for reach in candidates if self._viewers[reach].visitors == 0]
        if not idle:
            raise Overloaded(f"{told} are open, the most at one time; try again in a minute", retry_after_s=60.0)
        longest = min(idle, key=lambda reach: self._viewers[reach].idle_since)
        await run_in_threadpool(stop_viser, self._viewers.pop(longest).server)

    async def close(self) -> None:
        """Stop everything."""
        if self._sweeper is not None:
            self._sweeper.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._sweeper
            self._sweeper = None
        async with self._lock:
            for viewer in self._viewers.values():
                await run_in_threadpool(stop_viser, viewer.server)
            self._viewers.clear()

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(max(self._idle_seconds / 4, 0.05))
            await self.stop_idle()

    def _start(self, reach: Reach) -> OrganisationViewer:
        ColourScale(0.0, 1.0).rgb(np.zeros(1))  # loads what colours need before the first picture waits for it
        viewer = OrganisationViewer(start_viser(), self.content(reach), secrets.token_urlsafe(32))

        def welcome(client: ClientHandle) -> None:
            try:
                viewer.welcome(client)
            except Exception:
                _log.exception("a scene could not be made for organisation %s", reach.organisation_id)

        viewer.server.on_client_connect(welcome)
        viewer.server.on_client_disconnect(viewer.farewell)
        return viewer
