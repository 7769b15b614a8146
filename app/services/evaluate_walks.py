"""How good are maps and fixes on real walks? Hold walks out, map the rest, locate windows of the held-out ones.

A folder holds one folder per floor with walks of format `indoor-location-2020`. One walk in five, by file name, is held
out; nothing of it is used for the maps. Windows are cut from held-out walks by distance, with displacement and heading
as the phone reckoned them; labels are used only to judge. With `folds`, every fifth of the walks is held out in its
turn, and windows of all of them are judged. Floors and windows run in child processes, each with BLAS on one thread.
"""

from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from app.field.body_bias import BodyBias
from app.field.grid import FieldGrid
from app.field.spec import FittedMap, MapSpec, Noise, Score
from app.geometry import Array
from app.services.fold_maps import MappingPlan, map_fold, places_m
from app.services.held_out_walks import (
    HELD_OUT_EVERY,
    Told,
    collected,
    hold_out,
    on_one_thread,
    read_floors,
    session_of,
)
from app.services.judge_windows import Floors, JudgedWindow, Question, judge_walk
from app.services.map_scores import Estimate, HeldOutWalk, MapScore, held_out_walk, nlpd_gain, score_map
from app.survey.walk import Walk

__all__ = ["NOISES", "EvaluatedFloor", "Evaluation", "EvaluationPlan", "evaluate_walks"]

NOISES: tuple[Noise, ...] = ("walk", "white")


@dataclass(frozen=True, slots=True)
class EvaluationPlan:
    """What to evaluate: the maps' parameters, how windows are asked, child processes.

    session_bias   take the hard iron that the mapping walks show for a calibration session out of its walks, held-out
                   ones included: a phone keeps its session, and its bias, from one walk to the next
    rehearse       leave the held-out walks out altogether and hold out one in five of the others: for choosing
                   parameters, so that nothing is tuned on the walks that judge
    folds          hold every fifth of the walks out in its turn, and judge the windows of all; maps are not judged
    """

    spec: MapSpec = field(default_factory=lambda: MapSpec(resolution_m=1.0))
    question: Question = field(default_factory=Question)
    session_bias: bool = True
    rehearse: bool = False
    folds: bool = False
    processes: int = 2


@dataclass(frozen=True, slots=True)
class EvaluatedFloor:
    """One floor's map: its walks, its own score, and its score on the walks that were held out.

    held_out_white: of a map of the same walks that takes all errors to be white. nlpd_gain_over_white: how much lower
    the held-out NLPD is than that map's.
    """

    floor_id: str
    mapping_walks: tuple[str, ...]
    held_out_walks: tuple[str, ...]
    components: tuple[str, ...]
    leave_one_out: Score | None
    leave_one_out_reason: str | None
    held_out: MapScore | None
    held_out_white: MapScore | None
    nlpd_gain_over_white: Estimate | None
    hyperparameters: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Everything that was found, window by window. floors: empty where every fold was held out."""

    floors: tuple[EvaluatedFloor, ...]
    windows: tuple[JudgedWindow, ...]
    unreadable: Mapping[str, str]


def evaluate_walks(directory: Path, plan: EvaluationPlan, told: Told) -> Evaluation:
    """Evaluate the floors under `directory`. Raises InvalidInput when there is nothing to evaluate."""
    floors, unreadable = read_floors(directory, told)
    if plan.rehearse:
        floors = {floor_id: {name: walks[name] for name in hold_out(walks)[0]} for floor_id, walks in floors.items()}
    if not plan.folds:
        evaluated, windows = _evaluate_fold(floors, HELD_OUT_EVERY - 1, plan, told)
        return Evaluation(tuple(evaluated), tuple(windows), unreadable)
    judged = []
    for fold in range(HELD_OUT_EVERY):
        judged += _evaluate_fold(floors, fold, plan, _numbered(told, fold))[1]
    return Evaluation((), tuple(judged), unreadable)


def _numbered(told: Told, fold: int) -> Told:
    return lambda stage, done, total: told(f"{stage}, fold {fold + 1} of {HELD_OUT_EVERY}", done, total)


def _evaluate_fold(
    floors: Mapping[str, Mapping[str, Walk]], fold: int, plan: EvaluationPlan, told: Told
) -> tuple[list[EvaluatedFloor], list[JudgedWindow]]:
    noises = (plan.spec.noise,) if plan.folds else NOISES
    mapped = map_fold(floors, fold, MappingPlan(plan.spec, plan.session_bias, noises, plan.processes), told)
    floors, mapping, biases, by_noise = mapped
    fitted = {floor_id: by_noise[floor_id, plan.spec.noise] for floor_id in floors}
    tasks = [
        (floor_id, name, floors[floor_id][name], places_m(mapping[floor_id]))
        for floor_id in floors
        for name in hold_out(floors[floor_id], fold)[1]
    ]
    arguments = ({floor_id: each.grid for floor_id, each in fitted.items()}, plan.question)
    with ProcessPoolExecutor(plan.processes, get_context("spawn"), _ready_to_locate, arguments) as pool:
        judged = dict(collected({pool.submit(_judge_walk, *task): task[:2] for task in tasks}, told, "locating"))
    windows = [window for key in sorted(judged) for window in judged[key]]
    if plan.folds:
        return [], windows
    return [
        _evaluated_floor(floor_id, walks, fitted[floor_id], by_noise[floor_id, "white"], biases[floor_id])
        for floor_id, walks in floors.items()
    ], windows


_ready: list[tuple[Floors, Question]] = []


def _ready_to_locate(grids: Mapping[str, Any], question: Question) -> None:
    """Once per child process."""
    on_one_thread()
    _ready[:] = [(Floors.of(grids), question)]


def _judge_walk(floor_id: str, name: str, walk: Walk, mapped_m: Array) -> list[JudgedWindow]:
    floors, question = _ready[0]
    return judge_walk(floors, floor_id, name, walk, mapped_m, question)


def _evaluated_floor(
    floor_id: str,
    walks: Mapping[str, Walk],
    fitted: FittedMap,
    white: FittedMap,
    biases: Mapping[str, BodyBias] | None,
) -> EvaluatedFloor:
    mapping, held_out = hold_out(walks)
    mapped_m = places_m({name: walks[name].samples for name in mapping})

    def against(grid: FieldGrid) -> list[HeldOutWalk]:
        samples = [walks[name].samples for name in held_out]
        return [held_out_walk(grid, each, mapped_m, session_of(each, biases)) for each in samples]

    judged, judged_white = against(fitted.grid), against(white.grid)
    return EvaluatedFloor(
        floor_id=floor_id,
        mapping_walks=tuple(mapping),
        held_out_walks=tuple(held_out),
        components=fitted.grid.component_names,
        leave_one_out=fitted.score,
        leave_one_out_reason=fitted.score_reason,
        held_out=score_map(judged),
        held_out_white=score_map(judged_white),
        nlpd_gain_over_white=nlpd_gain(judged, judged_white),
        hyperparameters=fitted.hyperparameters,
    )
