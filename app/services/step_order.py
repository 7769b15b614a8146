"""Steps in the order of their numbers, whatever order they came in.

A step whose forerunner is missing waits for it, until enough has come after it that the gap is given up.
Displacements are counted from the first step, so nothing else is lost with a step that never came. Pure.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from app.errors import Fault, InvalidInput

__all__ = ["MOST_GAPS", "WAIT_S", "WAIT_STEPS", "Arranged", "RawStep", "arrange"]

RawStep = dict[str, Any]
"""A step as it was sent: `number`, `t_s`, `b_ut`, `displacement_m` and what else there was of it."""

WAIT_STEPS, WAIT_S = 32, 1.0
"""A gap is given up once this many steps wait behind it, or steps over this long."""
MOST_GAPS = 1000
LONGEST_STEP_M = 50.0
"""Between a step and the next that was sent: nobody indoors is as fast, and a jump is a fault of the sender."""


@dataclass(frozen=True, slots=True)
class Arranged:
    """What a batch comes to.

    ready       steps to be followed now, in order
    waiting     steps that wait, in order; `waiting_new` tells how many of them came with this batch
    gaps        [first, stop) of numbers that were given up so far; the last MOST_GAPS of them
    next_step   the number that is waited for after `ready`
    duplicates  sent again: followed already, or waiting
    late        came after their gap was given up
    """

    ready: tuple[RawStep, ...]
    waiting: tuple[RawStep, ...]
    gaps: tuple[tuple[int, int], ...]
    next_step: int
    accepted: int
    duplicates: int
    late: int


def arrange(
    sent: Sequence[RawStep], waiting: Sequence[RawStep], gaps: Sequence[tuple[int, int]], next_step: int,
    last: RawStep | None, flush: bool = False,
) -> Arranged:  # fmt: skip
    """Put steps in order after `last`, the one followed before. `flush` waits for nothing.

    Raises InvalidInput for a step that is earlier than one of a smaller number, or too far from it; nothing is then
    arranged.
    """
    known = {step["number"] for step in waiting}
    fresh: dict[int, tuple[int, RawStep]] = {}
    duplicates = late = 0
    for index, step in enumerate(sent):
        number = step["number"]
        if number < next_step and any(first <= number < stop for first, stop in gaps):
            late += 1
        elif number < next_step or number in known or number in fresh:
            duplicates += 1
        else:
            fresh[number] = index, step
    places: list[tuple[int | None, RawStep]] = [(None, step) for step in waiting]
    places = sorted([*places, *fresh.values()], key=lambda each: each[1]["number"])
    _check(places, last)
    ready, left, given_up, reached = _in_turn([step for _, step in places], next_step, flush)
    kept = (*gaps, *given_up)[-MOST_GAPS:]
    return Arranged(tuple(ready), tuple(left), kept, reached, len(fresh), duplicates, late)


def _in_turn(
    steps: list[RawStep], next_step: int, flush: bool
) -> tuple[list[RawStep], list[RawStep], list[tuple[int, int]], int]:
    """Steps that may be followed, those that wait, gaps given up, and the number waited for."""
    ready: list[RawStep] = []
    given_up: list[tuple[int, int]] = []
    at = 0
    while at < len(steps):
        number = steps[at]["number"]
        if number > next_step:
            behind = steps[at:]
            if not flush and len(behind) < WAIT_STEPS and behind[-1]["t_s"] - behind[0]["t_s"] < WAIT_S:
                break
            given_up.append((next_step, number))
        ready.append(steps[at])
        next_step, at = number + 1, at + 1
    return ready, steps[at:], given_up, next_step


def _check(places: Sequence[tuple[int | None, RawStep]], last: RawStep | None) -> None:
    """Raise InvalidInput, at a step of this batch: what waits was checked when it came."""
    before: tuple[int | None, RawStep] | None = None if last is None else (None, last)
    for place in places:
        if before is not None:
            index = place[0] if place[0] is not None else before[0]
            _check_pair(before[1], place[1], f"/body/steps/{index or 0}")
        before = place


def _check_pair(before: RawStep, after: RawStep, where: str) -> None:
    if after["t_s"] < before["t_s"]:
        reason = (
            f"step {after['number']} at {after['t_s']:.6g} s is earlier than step {before['number']} at "
            f"{before['t_s']:.6g} s; nothing of this batch was followed: send it again with times that do not decrease"
        )
        raise InvalidInput(reason, Fault(f"{where}/t_s", reason))
    here, there = after.get("displacement_m"), before.get("displacement_m")
    if here is not None and there is not None:
        moved_m = sum((a - b) ** 2 for a, b in zip(here, there, strict=True)) ** 0.5
        if moved_m > LONGEST_STEP_M:
            reason = (
                f"step {after['number']} is {moved_m:,.0f} m from step {before['number']}, more than "
                f"{LONGEST_STEP_M:g} m; displacement_m is metres from the track's first step"
            )
            raise InvalidInput(reason, Fault(f"{where}/displacement_m", reason))
