"""How well are walks followed? Hold walks out, map the rest, and let each filter follow the held-out ones.

Filters get what a phone knows of itself: field, steps, turns, and a heading with its deviation. Labels only judge.
Walks are followed on their own floor, or on all floors at once, in child processes, each with BLAS on one thread.
The same steps are given to all filters, on the same maps.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from time import process_time

from app.field.grid import FieldGrid
from app.field.spec import MapSpec
from app.services.compared_filters import make_filters
from app.services.fold_maps import MappingPlan, map_fold, places_m
from app.services.followed_walks import Filter, WalkToFollow, real_walk
from app.services.held_out_walks import HELD_OUT_EVERY, Told, collected, hold_out, on_one_thread, read_floors
from app.services.track_scores import JudgedTrack, judge_track
from app.survey.walk import Walk
from app.tracking.options import TrackOptions

__all__ = ["PHONE", "TrackEvaluation", "TrackPlan", "evaluate_tracks", "follow_all", "judged"]

PHONE = TrackOptions(bias_sd_uT=2.0, step_scale_sd=0.12)
"""What is not known of a phone that somebody carries."""

Ground = Mapping[str, FieldGrid]
"""The maps that are searched for a walk, by floor."""


@dataclass(frozen=True, slots=True)
class TrackPlan:
    """What to evaluate.

    folds        of the walks, each held out in its turn
    all_floors   search all floors for each walk, not only its own
    options      what the filters are told of the device
    particles    of the bootstrap particle filter
    """

    spec: MapSpec = field(default_factory=lambda: MapSpec(resolution_m=1.0))
    session_bias: bool = True
    folds: tuple[int, ...] = (HELD_OUT_EVERY - 1,)
    all_floors: bool = False
    options: TrackOptions = PHONE
    particles: int = 20_000
    seed: int = 0
    processes: int = 2


@dataclass(frozen=True, slots=True)
class TrackEvaluation:
    """Everything that was found, walk by walk and filter by filter."""

    tracks: tuple[JudgedTrack, ...]
    unreadable: Mapping[str, str]


def evaluate_tracks(directory: Path, plan: TrackPlan, told: Told) -> TrackEvaluation:
    """Evaluate the walks under `directory`. Raises InvalidInput when there is nothing to evaluate."""
    floors, unreadable = read_floors(directory, told)
    tracks: list[JudgedTrack] = []
    for fold in plan.folds:
        tracks += _evaluate_fold(floors, fold, plan, _numbered(told, fold) if len(plan.folds) > 1 else told)
    return TrackEvaluation(tuple(tracks), unreadable)


def _numbered(told: Told, fold: int) -> Told:
    return lambda stage, done, total: told(f"{stage}, fold {fold + 1} of {HELD_OUT_EVERY}", done, total)


def _evaluate_fold(
    floors: Mapping[str, Mapping[str, Walk]], fold: int, plan: TrackPlan, told: Told
) -> list[JudgedTrack]:
    noise = plan.spec.noise
    mapped = map_fold(floors, fold, MappingPlan(plan.spec, plan.session_bias, (noise,), plan.processes), told)
    grids = {floor_id: mapped.fitted[floor_id, noise].grid for floor_id in floors}
    grounds = dict.fromkeys(grids, grids) if plan.all_floors else {name: {name: grid} for name, grid in grids.items()}
    walks = [
        real_walk(floor_id, list(grounds[floor_id]).index(floor_id), name, mapped.floors[floor_id][name], near_m)
        for floor_id, near_m in ((each, places_m(mapped.mapping[each])) for each in floors)
        for name in hold_out(floors[floor_id], fold)[1]
    ]
    return follow_all(grounds, walks, plan, told)


def follow_all(
    grounds: Mapping[str, Ground], walks: Sequence[WalkToFollow], plan: TrackPlan, told: Told
) -> list[JudgedTrack]:
    """Each walk followed by each filter on the ground of its floor, in the order of the walks."""
    arguments = (grounds, plan)
    with ProcessPoolExecutor(plan.processes, get_context("spawn"), _ready_to_follow, arguments) as pool:
        futures = {pool.submit(_follow, walk): k for k, walk in enumerate(walks)}
        followed = dict(collected(futures, told, "following"))
    return [track for k in sorted(followed) for track in followed[k]]


class _Ready:
    """What a child process holds: filters by ground, made when the first walk needs them."""

    def __init__(self, grounds: Mapping[str, Ground], plan: TrackPlan) -> None:
        self.grounds, self.plan = grounds, plan
        self.filters: dict[tuple[str, ...], list[Filter]] = {}

    def of(self, floor_id: str) -> list[Filter]:
        ground, plan = self.grounds[floor_id], self.plan
        key = tuple(ground)
        if key not in self.filters:
            self.filters[key] = make_filters(ground, plan.options, plan.particles, plan.seed)
        return self.filters[key]


_ready: list[_Ready] = []


def _ready_to_follow(grounds: Mapping[str, Ground], plan: TrackPlan) -> None:
    """Once per child process."""
    on_one_thread()
    _ready[:] = [_Ready(grounds, plan)]


def _follow(walk: WalkToFollow) -> list[JudgedTrack]:
    return [judged(each, walk) for each in _ready[0].of(walk.floor_id)]


def judged(technique: Filter, walk: WalkToFollow) -> JudgedTrack:
    """A walk followed by one filter, and judged."""
    began = process_time()
    rows = technique.follow_walk(walk.steps, walk.start)
    cpu_ms = 1e3 * (process_time() - began) / len(walk.steps)
    return judge_track(technique.name, technique.told, walk, rows, cpu_ms)
