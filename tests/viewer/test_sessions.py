"""Sessions of the page, by themselves."""

import asyncio

from app.errors import Unavailable
from app.services.key_ring import Identity
from app.services.reach import Reach
from app.viewer.sessions import RECHECK_SECONDS, SignedIn


def test_a_database_that_is_away_signs_nobody_out_and_a_key_that_ended_does() -> None:
    known: Identity | Exception | None = Identity(Reach("mine"), frozenset({"map:read"}), "id", "robot", "mine")
    now = 0.0

    def authenticate(_: str) -> Identity | None:
        if isinstance(known, Exception):
            raise known
        return known

    async def scenario() -> None:
        nonlocal known, now
        signed_in = SignedIn(authenticate, 3600.0, lambda: now)
        session = await signed_in.open("isd_key")
        assert session is not None
        ended = asyncio.create_task(signed_in.until_ended(session, 0.01))
        known, now = Unavailable("the database is away"), RECHECK_SECONDS
        await asyncio.sleep(0.1)
        assert not ended.done()
        known, now = None, 2.0 * RECHECK_SECONDS
        await asyncio.wait_for(ended, 10.0)
        assert len(signed_in) == 0

    asyncio.run(scenario())
