"""Starting and stopping viser servers: on loopback, at a free port, quietly, and never open to the world.

viser is imported here, inside the function, so that a web process which shows nobody the page never loads it.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["LOOPBACK", "start_viser", "stop_viser"]

LOOPBACK = "127.0.0.1"
_one_at_a_time = threading.Lock()


def start_viser() -> ViserServer:
    """A viser server on 127.0.0.1 at an ephemeral port, which refuses to open a public tunnel. Blocks for a moment."""
    import viser

    # Said whenever a browser leaves while its scene is being drawn, which is nobody's fault.
    warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)

    class LoopbackServer(viser.ViserServer):
        """viser lets any connected client ask for a public share address; this one has none to give."""

        def request_share_url(self, verbose: bool = True) -> str | None:
            return None

    with _quiet_console():
        server = LoopbackServer(host=LOOPBACK, port=0, verbose=False)
    server.scene.world_axes.visible = False
    _light(server)
    server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=(33, 145, 140))
    return server


def _light(server: ViserServer) -> None:
    """An even light and a weak one from above: arrows keep the colours they are given, which viser's own bleach."""
    server.scene.configure_default_lights(enabled=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_ambient("/light", intensity=2.6)
    server.scene.add_light_directional("/light/above", intensity=1.6, position=(4.0, -6.0, 10.0))


def stop_viser(server: ViserServer) -> None:
    """Stop a server and wait for its threads."""
    with _quiet_console():
        server.stop()


@contextmanager
def _quiet_console() -> Iterator[None]:
    """viser prints its loopback address, which is of no use to anybody, on rich's shared console."""
    import rich

    console = rich.get_console()
    with _one_at_a_time:
        before, console.quiet = console.quiet, True
        try:
            yield
        finally:
            console.quiet = before
