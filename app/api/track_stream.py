"""Follow a track over a WebSocket: steps come as they are taken, an answer says what is stored.

The first message says which number is waited for, so that a client that lost its connection goes on from there. What
has arrived while a batch was followed is the next batch: a fast device is answered less often, never late. Reading
stops while too much waits, and TCP then slows the sender down. Several connections to one track take turns, batch by
batch; a step that both send is a duplicate to one of them. A stream ends with its key, whether steps come or not.

A message of ours is `{"type": "ready" | "estimate" | "problem", ...}`; of the client's `{"type": "steps", "steps":
[...], "flush"?}`, or a single step `{"type": "step", "number", ...}`.
"""

import asyncio
import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import msgspec
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from pydantic import ValidationError
from sqlalchemy.exc import OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from app.api.auth import Identity, recognised, secret_of, until_refused
from app.api.context import Context
from app.api.problems import Forbidden, Unauthorised, isodyn_problem, problem_response, validation_problem
from app.api.track_answer import steps_answer
from app.api.track_request import MOST_STEPS, StepsBody, raw_steps
from app.errors import Conflict, Fault, InvalidInput, IsodynError, NotFound, Unavailable
from app.services.follow import Outcome
from app.services.step_order import RawStep
from app.services.track_spec import StepKind

__all__ = ["CLOSE_ENDED", "CLOSE_NOT_FOUND", "CLOSE_UNAUTHORISED", "router"]

router = APIRouter()

PROTOCOL, BEARER = "isodyn.v1", "bearer."
CLOSE_UNAUTHORISED, CLOSE_NOT_FOUND, CLOSE_ENDED, CLOSE_UNAVAILABLE = 4401, 4404, 4409, 1013
MOST_AHEAD_BYTES = 2**20
"""Read ahead of the batch in work: minutes of a fast device's steps. The server's own queue, and TCP's, come after."""
_CLOSES: dict[type[IsodynError], int] = {
    Unauthorised: CLOSE_UNAUTHORISED, Forbidden: CLOSE_UNAUTHORISED, NotFound: CLOSE_NOT_FOUND, Conflict: CLOSE_ENDED,
    Unavailable: CLOSE_UNAVAILABLE,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Message:
    steps: list[RawStep]
    flush: bool


@router.websocket("/v1/tracks/{track_id}/stream")
async def stream(browser: WebSocket, track_id: str) -> None:
    """Refused before it is opened (HTTP 401, 403, 404, 409, 429, 503 with a problem document), or ready."""
    context: Context = browser.app.state.context
    secret = _secret(browser)
    with contextlib.ExitStack() as held:
        try:
            _check_origin(browser)
            identity = browser.state.identity = await recognised(context, secret, "locate")
            held.enter_context(context.key_limits.stream(identity.key_id))
            kind, ready = await context.follows.run(partial(_ready, context, identity, track_id))
        except IsodynError as error:
            await browser.send_denial_response(isodyn_problem(error))
            return
        except (OperationalError, PoolTimeout):
            away = Unavailable("the database cannot be reached now; connect again in a moment")
            await browser.send_denial_response(isodyn_problem(away))
            return
        offered = browser.scope.get("subprotocols", ())
        await browser.accept(subprotocol=PROTOCOL if PROTOCOL in offered else None)
        await _Stream(browser, context, secret, track_id, kind).run(ready)


def _secret(browser: WebSocket) -> str | None:
    """The key: of `Authorization`, or of the subprotocol `bearer.<key>`, which is what browsers can send."""
    secret = secret_of(browser)
    if secret is not None:
        return secret
    offered = [each for each in browser.scope.get("subprotocols", ()) if each.startswith(BEARER)]
    return offered[0].removeprefix(BEARER) if offered else None


def _check_origin(browser: WebSocket) -> None:
    """A browser's page says where it is from; only our own may connect. Devices say nothing."""
    origin, host = browser.headers.get("origin"), browser.headers.get("host", "")
    if origin is not None and origin.partition("://")[2].lower() != host.lower():
        raise Forbidden("this page is of another origin; streams are for devices, and for pages of this server")


def _ready(context: Context, identity: Identity, track_id: str) -> tuple[StepKind, dict[str, Any]]:
    """What the track's steps are, and the first message. Raises NotFound, Conflict."""
    live = context.follower.live(track_id, identity.reach)
    context.follower.check_active(live)
    return live.kind, {
        "type": "ready", "track_id": track_id, "status": "active", "frame": live.kind.frame,
        "next_step": live.next_step, "waiting": len(live.waiting), "most_steps": MOST_STEPS, "estimate": live.estimate,
    }  # fmt: skip


class _Stream:
    """One connection: a task reads ahead, and batch after batch is followed and answered."""

    def __init__(self, browser: WebSocket, context: Context, secret: str | None, track_id: str, kind: StepKind) -> None:
        self._browser, self._context, self._secret = browser, context, secret
        self._track_id, self._kind = track_id, kind
        self._read: asyncio.Queue[str | bytes | None] = asyncio.Queue()
        self._ahead_bytes, self._room = 0, asyncio.Event()
        self._gone = False
        self._refused: IsodynError | None = None

    async def run(self, ready: dict[str, Any]) -> None:
        await self._send(ready)
        tasks = asyncio.create_task(self._read_on()), asyncio.create_task(self._watch())
        try:
            while not self._gone and (first := await self._read.get()) is not None:
                if not await self._answer(self._with_waiting(first)):
                    return
            if self._refused is not None:
                await self._refuse(self._refused)
        except (WebSocketDisconnect, RuntimeError, asyncio.CancelledError):
            return  # gone, or the server stops, while it was answered: what was followed is stored
        finally:
            for task in tasks:
                task.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await task

    async def _watch(self) -> None:
        """Until the key has ended; then so does the stream, after the batch in work."""
        self._refused = await until_refused(self._context, self._secret, "locate")
        await self._read.put(None)

    async def _read_on(self) -> None:
        """Until the client goes; waits while too much is read ahead, and the client with it."""
        while True:
            while self._ahead_bytes > MOST_AHEAD_BYTES:
                self._room.clear()
                await self._room.wait()
            message = await self._browser.receive()
            if message["type"] == "websocket.disconnect":
                await self._read.put(None)
                return
            text = message.get("text")
            told = text if text is not None else message.get("bytes", b"")
            self._ahead_bytes += len(told)
            await self._read.put(told)

    def _with_waiting(self, first: str | bytes) -> list[str | bytes]:
        """The first message and those that came meanwhile."""
        messages = [first]
        while not self._read.empty():
            another = self._read.get_nowait()
            if another is None:
                self._gone = True
                break
            messages.append(another)
        self._ahead_bytes -= sum(map(len, messages))
        self._room.set()
        return messages

    async def _answer(self, messages: Sequence[str | bytes]) -> bool:
        """Follow what the messages hold. False when the connection was closed."""
        read = []
        for message in messages:
            try:
                read.append(_read_message(message, self._kind))
            except ValidationError as error:
                found = [{**each, "loc": ("body", *each["loc"])} for each in error.errors()]
                await self._problem(validation_problem(found))
            except InvalidInput as error:
                await self._problem(isodyn_problem(error))
        for together in _joined(read):
            if not await self._follow(together):
                return False
        return True

    async def _follow(self, messages: Sequence[_Message]) -> bool:
        """One batch; if it is refused, message by message, so that a faulty one spoils no other."""
        try:
            identity = await recognised(self._context, self._secret, "locate")
            steps = [step for message in messages for step in message.steps]
            await self._slow_down(len(steps))
            outcome = await self._context.follower.follow(
                self._track_id, identity.reach, steps, any(message.flush for message in messages)
            )
        except InvalidInput as error:
            if len(messages) > 1:
                return all([await self._follow([message]) for message in messages])
            await self._problem(isodyn_problem(error))
            return True
        except IsodynError as error:
            await self._refuse(error)
            return False
        except (OperationalError, PoolTimeout):
            detail = "the database cannot be reached now; nothing was stored, connect again and send it again"
            await self._problem(problem_response(503, "unavailable", "Unavailable", detail))
            await self._browser.close(CLOSE_UNAVAILABLE)
            return False
        await self._send(_estimate(outcome))
        return True

    async def _slow_down(self, steps: int) -> None:
        """A stream that is faster than it may be waits."""
        while (wait_s := self._context.step_rate.take(self._track_id, steps)) > 0.0:
            await asyncio.sleep(min(wait_s, 1.0))

    async def _refuse(self, error: IsodynError) -> None:
        await self._problem(isodyn_problem(error))
        await self._browser.close(next((code for kind, code in _CLOSES.items() if isinstance(error, kind)), 1011))

    async def _problem(self, answer: Any) -> None:
        await self._send({"type": "problem", "problem": msgspec.json.decode(bytes(answer.body))})

    async def _send(self, message: dict[str, Any]) -> None:
        await self._browser.send_text(msgspec.json.encode(message).decode())


def _estimate(outcome: Outcome) -> dict[str, Any]:
    return {"type": "estimate", **steps_answer(outcome)}


def _read_message(message: str | bytes, steps_are: StepKind) -> _Message:
    """Raises InvalidInput, ValidationError."""
    try:
        told = msgspec.json.decode(message)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidInput(f"the message is not JSON: {error}", Fault("/body", "send a JSON object")) from error
    kind = told.pop("type", None) if isinstance(told, dict) else None
    if kind == "step":
        told = {"steps": [told]}
    elif kind != "steps":
        reason = 'a message is {"type": "steps", "steps": [...]} or {"type": "step", "number": ..., ...}'
        raise InvalidInput(reason, Fault("/body/type", reason))
    body = StepsBody.model_validate(told)
    return _Message(raw_steps(body, steps_are), body.flush)


def _joined(messages: Sequence[_Message]) -> list[list[_Message]]:
    """Messages in batches of at most MOST_STEPS steps."""
    batches: list[list[_Message]] = []
    size = 0
    for message in messages:
        if not batches or size + len(message.steps) > MOST_STEPS:
            batches.append([])
            size = 0
        batches[-1].append(message)
        size += len(message.steps)
    return batches
