"""The filters that are compared, ours first, behind one small interface, and dead reckoning beside them.

Filters that have no states of their own say `converged` where their own 95 % radius is small, the same for all. Those
that cannot find themselves are told the true place and heading of the first step, which flatters them. All of them
compare readings with the map once per cell, half a metre at least: nearer ones tell nothing new.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from app.field.grid import FieldGrid
from app.positioning.floors import SearchableFloor, prepare_floors
from app.services.filter_floors import Floor
from app.services.followed_walks import NOWHERE, Filter, Rows, Start, ToldWhat, rows_of
from app.services.source_particles import SourceParticles
from app.services.told_filters import DeadReckoningOnly, KalmanFixes, MadContour
from app.tracking.options import TrackOptions
from app.tracking.step import Step
from app.tracking.track import begin, follow, make_tracker

__all__ = ["Adaptive", "make_filters"]

UNKNOWN = np.full((2, 2), np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Adaptive:
    """Ours: from an unknown start, with states of its own."""

    floors: tuple[SearchableFloor, ...]
    options: TrackOptions
    seed: int = 0
    name: str = "adaptive"
    told: ToldWhat = "nothing"

    def follow_walk(self, steps: tuple[Step, ...], start: Start) -> Rows:
        tracker = make_tracker(self.floors, "level", self.options, self.seed)
        followed, floor, position, covariance, says = begin(), [], [], [], []
        for step in steps:
            after = follow(tracker, followed, step)
            followed, estimate = after.state, after.estimate
            floor.append(NOWHERE if estimate is None else estimate.floor)
            position.append(np.full(2, np.nan) if estimate is None else np.array(estimate.position_m[:2]))
            covariance.append(UNKNOWN if estimate is None else estimate.covariance_m2)
            says.append(str(followed.state))
        return rows_of(steps, floor, position, covariance, says)


def make_filters(grids: Mapping[str, FieldGrid], options: TrackOptions, particles: int, seed: int) -> list[Filter]:
    """All of them on these floors, in the order they are given."""
    floors = tuple(Floor.of(floor_id, grid) for floor_id, grid in grids.items())
    return [
        Adaptive(tuple(prepare_floors(grids)), options, seed),
        SourceParticles(floors, options, particles, seed),
        KalmanFixes(floors, options),
        MadContour(floors, options),
        DeadReckoningOnly(floors, options),
    ]
