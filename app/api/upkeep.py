"""What a web process sees to once a minute, so that no request has to."""

import asyncio
import logging

from fastapi.concurrency import run_in_threadpool
from sqlalchemy.exc import SQLAlchemyError

from app.api.context import Context
from app.services.audit_log import prune

__all__ = ["keep_up"]

_log = logging.getLogger(__name__)
EVERY_S = 60.0


async def keep_up(context: Context) -> None:
    """Until it is cancelled: keys were used, the log grows old, and so do the keys of an issuer."""
    while True:
        try:
            await run_in_threadpool(_once, context)
        except SQLAlchemyError as error:
            _log.warning("upkeep is tried again in a minute: %s", error)
        await asyncio.sleep(EVERY_S)


def _once(context: Context) -> None:
    if context.tokens is not None:
        context.tokens.keys.refresh()
    context.keys.note_uses()
    with context.transaction() as session:
        prune(session, context.settings.audit_days)
