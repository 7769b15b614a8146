"""Maps of all walks but those of one fold, floor by floor, in child processes, each with BLAS on one thread."""

from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import NamedTuple, TypeVar

import numpy as np

from app.field.body_bias import BodyBias
from app.field.fit import fit_map
from app.field.samples import Samples
from app.field.session_bias import estimate_session_biases
from app.field.spec import FittedMap, MapSpec, Noise
from app.geometry import Array
from app.services.held_out_walks import Told, calibrate_sessions, collected, hold_out, on_one_thread
from app.survey.walk import Walk

__all__ = ["FoldMaps", "MappingPlan", "fit_floors", "map_fold", "places_m"]

Key = TypeVar("Key")


@dataclass(frozen=True, slots=True)
class MappingPlan:
    """The maps' parameters, whether session biases are taken out, which noises are fitted, child processes."""

    spec: MapSpec
    session_bias: bool
    noises: tuple[Noise, ...]
    processes: int


class FoldMaps(NamedTuple):
    """floors: all walks by floor and name, free of their session's bias where that is asked for
    mapping: samples of the walks that were mapped, as they were recorded
    biases: of sessions, by floor; None where none are taken out
    fitted: by floor and noise
    """

    floors: Mapping[str, Mapping[str, Walk]]
    mapping: Mapping[str, Mapping[str, Samples]]
    biases: Mapping[str, Mapping[str, BodyBias] | None]
    fitted: Mapping[tuple[str, Noise], FittedMap]


def map_fold(floors: Mapping[str, Mapping[str, Walk]], fold: int, plan: MappingPlan, told: Told) -> FoldMaps:
    """Map every floor by the walks that are not of the fold; nothing of the others enters, nor their sessions' bias."""
    mapping = {floor_id: {name: walks[name].samples for name in hold_out(walks, fold)[0]}
               for floor_id, walks in floors.items()}  # fmt: skip
    biases: dict[str, Mapping[str, BodyBias] | None] = dict.fromkeys(floors)
    if plan.session_bias:
        biases = {floor_id: estimate_session_biases(samples) for floor_id, samples in mapping.items()}
        floors = {floor_id: calibrate_sessions(walks, biases[floor_id] or {}) for floor_id, walks in floors.items()}
    spec = replace(plan.spec, hard_iron=plan.session_bias)
    asked = {
        (floor_id, noise): (samples, replace(spec, noise=noise))
        for floor_id, samples in mapping.items()
        for noise in plan.noises
    }
    return FoldMaps(floors, mapping, biases, fit_floors(asked, plan.processes, told))


def fit_floors(
    asked: Mapping[Key, tuple[Mapping[str, Samples], MapSpec]], processes: int, told: Told
) -> dict[Key, FittedMap]:
    """Maps of walks by name, each with its parameters, whatever they are called by."""
    with ProcessPoolExecutor(processes, get_context("spawn"), initializer=on_one_thread) as pool:
        fits = {pool.submit(fit_map, samples, spec): key for key, (samples, spec) in asked.items()}
        return dict(collected(fits, told, "fitting maps"))


def places_m(walks: Mapping[str, Samples]) -> Array:
    """(n, 2) positions of walks."""
    return np.concatenate([samples.p_building_m[:, :2] for samples in walks.values()])
