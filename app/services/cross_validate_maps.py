"""Maps judged by every walk of a floor: each fold of the walks is held out once, and the map of the rest asked for it.

Few walks judge little: one in five held out of a small floor is four or five, and two such draws differ by more than
most choices matter. Nothing of a walk enters the map that is judged by it, nor the offset of its calibration session.
"""

from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from app.field.fit import fit_map
from app.field.session_bias import estimate_session_biases
from app.field.spec import MapSpec
from app.services.evaluate_walks import NOISES, EvaluationPlan
from app.services.held_out_walks import (
    HELD_OUT_EVERY,
    Told,
    calibrate_sessions,
    collected,
    hold_out,
    on_one_thread,
    read_floors,
    session_of,
)
from app.services.map_scores import Estimate, HeldOutWalk, MapScore, held_out_walk, nlpd_gain, score_map
from app.survey.walk import Walk

__all__ = ["CrossValidatedFloor", "CrossValidation", "cross_validate_maps"]


@dataclass(frozen=True, slots=True)
class CrossValidatedFloor:
    """held_out_white: of maps of the same walks that take all errors to be white; nlpd_gain_over_white: how much lower

    the NLPD is than theirs.
    """

    floor_id: str
    held_out: MapScore | None
    held_out_white: MapScore | None
    nlpd_gain_over_white: Estimate | None


@dataclass(frozen=True, slots=True)
class CrossValidation:
    """floors: one by one and, where there are several, all of them together."""

    floors: tuple[CrossValidatedFloor, ...]
    unreadable: Mapping[str, str]


def cross_validate_maps(directory: Path, plan: EvaluationPlan, told: Told) -> CrossValidation:
    """Judge the maps of the floors under `directory`. Raises InvalidInput when there is nothing to evaluate."""
    floors, unreadable = read_floors(directory, told)
    spec = replace(plan.spec, hard_iron=plan.session_bias)
    with ProcessPoolExecutor(plan.processes, get_context("spawn"), initializer=on_one_thread) as pool:
        folds = {
            pool.submit(_judge_fold, walks, fold, replace(spec, noise=noise)): (floor_id, noise, fold)
            for floor_id, walks in floors.items()
            for fold in range(HELD_OUT_EVERY)
            for noise in NOISES
        }
        judged = dict(collected(folds, told, "holding walks out"))
    by_noise = {
        (floor_id, noise): [walk for fold in range(HELD_OUT_EVERY) for walk in judged[floor_id, noise, fold]]
        for floor_id in floors
        for noise in NOISES
    }
    rows = [_floor(floor_id, by_noise[floor_id, "walk"], by_noise[floor_id, "white"]) for floor_id in floors]
    if len(floors) > 1:
        together = ([walk for floor_id in floors for walk in by_noise[floor_id, noise]] for noise in NOISES)
        rows.append(_floor("all", *together))
    return CrossValidation(tuple(rows), unreadable)


def _judge_fold(walks: Mapping[str, Walk], fold: int, spec: MapSpec) -> list[HeldOutWalk]:
    """The held-out walks of one fold against the map of the others."""
    mapping, held_out = hold_out(walks, fold)
    samples = {name: walks[name].samples for name in mapping}
    biases = estimate_session_biases(samples) if spec.hard_iron else None
    calibrated = calibrate_sessions({name: walks[name] for name in held_out}, biases or {})
    grid = fit_map(samples, spec).grid
    mapped_m = np.concatenate([each.p_building_m[:, :2] for each in samples.values()])
    asked = [calibrated[name].samples for name in held_out]
    return [held_out_walk(grid, each, mapped_m, session_of(each, biases)) for each in asked]


def _floor(floor_id: str, walks: Sequence[HeldOutWalk], white: Sequence[HeldOutWalk]) -> CrossValidatedFloor:
    return CrossValidatedFloor(floor_id, score_map(walks), score_map(white), nlpd_gain(walks, white))
