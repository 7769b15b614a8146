"""A track's state as bytes: nothing of it is lost, and damage is noticed."""

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

from app.errors import CorruptArtefact
from app.field.grid import FieldGrid
from app.positioning.locate import prepare_floor
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.step import Step
from app.tracking.stored_state import state_from_bytes, state_nbytes, state_to_bytes
from app.tracking.track import begin, follow, make_tracker
from app.tracking.track_state import Tracker, TrackState


@pytest.fixture(scope="module")
def tracker(hall_grid: FieldGrid) -> Tracker:
    options = TrackOptions(particles=600)
    return make_tracker([prepare_floor("hall", hall_grid)], "level", options, 3, StartPrior((5.0, 4.0, 1.2), 1.0))


def steps_from(steps: list[dict[str, Any]], first: int, stop: int) -> list[Step]:
    return [
        Step(k, steps[k]["t_s"], np.array(steps[k]["b_ut"]), np.array(steps[k]["displacement_m"]))
        for k in range(first, stop)
    ]


def same(one: Any, two: Any) -> bool:
    """Every bit, type and order in memory of two values alike."""
    if is_dataclass(one):
        return type(one) is type(two) and all(same(getattr(one, f.name), getattr(two, f.name)) for f in fields(one))
    if isinstance(one, tuple):
        return isinstance(two, tuple) and len(one) == len(two) and all(map(same, one, two))
    if isinstance(one, np.ndarray):
        alike = one.dtype == two.dtype and one.shape == two.shape and one.tobytes() == two.tobytes()
        dense = one.flags.c_contiguous or one.flags.f_contiguous
        return alike and (not dense or one.ndim < 2 or one.size == 0 or one.strides == two.strides)
    return bool(one == two) or (one != one and two != two)


def test_followed_on_from_bytes_is_the_same_as_followed_on(tracker: Tracker, hall_steps: Any) -> None:
    steps = hall_steps(count=200)
    state = begin()
    assert same(state_from_bytes(state_to_bytes(state)), state)
    for step in steps_from(steps, 0, 150):
        state = follow(tracker, state, step).state
    stored = state_from_bytes(state_to_bytes(state))
    assert same(stored, state)
    assert state_to_bytes(stored) == state_to_bytes(state)
    for step in steps_from(steps, 150, 200):
        state, stored = follow(tracker, state, step).state, follow(tracker, stored, step).state
    assert same(stored, state)
    assert 0.5 * len(state_to_bytes(state)) < state_nbytes(state) < len(state_to_bytes(state))


def test_arrays_keep_the_order_of_their_elements_in_memory(tracker: Tracker, hall_steps: Any) -> None:
    state = begin()
    for step in steps_from(hall_steps(count=80), 0, 80):
        state = follow(tracker, state, step).state
    assert state.particles is not None
    state = replace(state, particles=replace(state.particles, rows=np.asfortranarray(state.particles.rows)))
    stored = state_from_bytes(state_to_bytes(state))
    assert stored.particles is not None
    assert stored.particles.rows.flags.f_contiguous
    assert same(stored, state)


def test_damaged_or_foreign_bytes_are_refused(tracker: Tracker) -> None:
    data = state_to_bytes(TrackState(path_m=3.0))
    for bad in (b"", b"PK", data[: len(data) // 2], data.replace(b'"path_m"', b'"path_x"')):
        with pytest.raises(CorruptArtefact):
            state_from_bytes(bad)
