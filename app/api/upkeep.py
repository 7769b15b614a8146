"""What a web process sees to now and then, so that no request has to."""

import asyncio
import logging
from collections.abc import Callable

from fastapi.concurrency import run_in_threadpool
from sqlalchemy.exc import SQLAlchemyError

from app.api.context import Context
from app.errors import IsodynError
from app.services.audit_log import prune
from app.services.keep_warm import keep_warm

__all__ = ["BACKGROUND", "note_uses_last"]

_log = logging.getLogger(__name__)
EVERY_S = 60.0
WARM_EVERY_S = 2.0


async def keep_up(context: Context) -> None:
    """Keys were used, the log grows old, and so do the keys of an issuer."""
    while True:
        await _tried(_once, context)
        await asyncio.sleep(EVERY_S)


def note_uses_last(context: Context) -> None:
    """When the server stops, which no database can keep it from."""
    try:
        context.keys.note_uses()
    except SQLAlchemyError as error:
        _log.warning("when keys were last used is not known to the minute: %s", error)


def _once(context: Context) -> None:
    if context.tokens is not None:
        context.tokens.keys.refresh()
    context.keys.note_uses()
    with context.transaction() as session:
        prune(session, context.settings.audit_days)


async def keep_maps_warm(context: Context) -> None:
    """A new map of a floor that is asked for is in memory before the next who asks."""
    while True:
        await asyncio.sleep(WARM_EVERY_S)
        await _tried(keep_warm, context.engine, context.grids)


async def end_idle_tracks(context: Context) -> None:
    """Whoever asks meanwhile is told by the time, not by this."""
    while True:
        await asyncio.sleep(min(60.0, max(context.settings.track_idle_timeout_s / 4.0, 1.0)))
        await _tried(context.follower.end_idle)


async def _tried(work: Callable[..., object], *arguments: object) -> None:
    """Do it in a thread; whatever goes wrong, it is tried again."""
    try:
        await run_in_threadpool(work, *arguments)
    except (SQLAlchemyError, IsodynError) as error:
        _log.warning("upkeep is tried again: %s", error)
    except Exception:
        _log.exception("upkeep failed, and is tried again")


BACKGROUND = (keep_up, keep_maps_warm, end_idle_tracks)
"""Each runs as long as the process, until it is cancelled."""
