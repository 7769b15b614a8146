"""Compile what following needs, before the first step has to wait for it."""

import numpy as np

from app.field.grid import FieldGrid
from app.positioning.locate import prepare_floor
from app.services.step_order import RawStep
from app.services.track_spec import StepKind
from app.services.track_steps import core_step
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.track import begin, follow, make_tracker

__all__ = ["warm_up_tracks"]


def warm_up_tracks() -> None:
    """Follow two steps on a map of nothing."""
    cells = np.zeros((1, 20, 20, 3), dtype=np.float32)
    grid = FieldGrid(
        "vector", (0.0, 0.0), 0.5, np.zeros(1), cells + 20, cells + 1, np.zeros((*cells.shape, 2), np.float32),
        np.ones(cells.shape[:3], dtype=bool), np.full(3, 20.0), np.ones(3), np.ones(3),
    )  # fmt: skip
    floor = prepare_floor("warm-up", grid)
    tracker = make_tracker([floor], "level", TrackOptions(), 0, StartPrior((5.0, 5.0, 0.0), 1.0))
    state = begin()
    for number in range(2):
        raw: RawStep = {"number": number, "t_s": 0.0, "b_ut": [20.0] * 3, "displacement_m": [float(number), 0.0, 0.0]}
        state = follow(tracker, state, core_step(raw, StepKind("level"))).state
