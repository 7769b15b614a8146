"""Engine `compromise`: the exact engine's map, told again at nodes that suit its length scale (Kuevor B10)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from app.field.compromise import compromise, interpolate, spanning_nodes
from app.field.estimate import FieldEstimate
from app.field.exact import (
    MAX_OBSERVATIONS,
    ExactPosterior,
    Observations,
    condition,
    estimate_of,
    learn_components,
)
from app.field.hard_iron import Cleaned
from app.field.observations import Walk
from app.field.spec import MapSpec, Progress
from app.field.tile_fit import FitState
from app.field.tiles import REACH_M
from app.geometry import Array

__all__ = ["MAX_NODES", "estimate_by_compromise"]

MAX_NODES = 2000
MOST_CANDIDATES = 200_000
CLOSER = 0.8
AGREEMENT = 0.15
"""Of the noise sd: a mean that differs by less adds one per cent to the error of a prediction. A smooth kernel has it
with nodes half a length apart; a rough one, whose detail is finer than its length, wants them closer."""
LEAST_NOISE_UT = 0.01


def estimate_by_compromise(
    walks: Sequence[Walk],
    cleaned: Cleaned,
    spec: MapSpec,
    previous: FitState | None,
    progress: Progress,
    *,
    with_covariance: bool = True,
    spacing_m: float | None = None,
) -> FieldEstimate:
    """The compromise of every component, hyper-parameters and all walks left out as in the exact engine.

    Of more observations than MAX_OBSERVATIONS that many are used, evenly spaced along the walks; `observations_used`
    says how many. with_covariance: False for the seed's method. spacing_m: of the nodes; None for half the shortest
    length, or less, so that the means agree. Where there would be more than MAX_NODES they lie farther apart.
    `cleaned` and `previous` are not made use of. Raises InvalidInput for a sum of kernels.
    """
    everything = Observations.of(walks)
    observations = everything[_evenly(len(everything), MAX_OBSERVATIONS)]
    processes = learn_components(spec, observations, progress)
    intermediate = condition(processes, observations)
    node_m, spacing_m = _nodes(intermediate, spacing_m)

    def told(some: Observations) -> list[ExactPosterior]:
        return [compromise(each, node_m, with_covariance) for each in condition(processes, some)]

    estimate = estimate_of(walks, spec, observations, processes, told, progress)
    return replace(
        estimate,
        hyperparameters=estimate.hyperparameters
        | {
            "nodes": len(node_m),
            "node_spacing_m": spacing_m,
            "observations_used": len(observations),
            "observations": len(everything),
            "rmse_against_intermediate_ut": _differences_uT(intermediate, told(observations)),
        },
    )


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    """Indices of all, or of `most` spread evenly."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)


def _nodes(intermediate: Sequence[ExactPosterior], spacing_m: float | None) -> tuple[Array, float]:
    """Nodes (n, 3) over the surveyed volume and their spacing: as asked, or chosen."""
    position_m = intermediate[0].position_m
    apart_m = spacing_m or min(each.process.length_m for each in intermediate) / 2.0
    while (node_m := _laid(position_m, apart_m)) is None:
        apart_m /= CLOSER
    while spacing_m is None and _disagree(intermediate, node_m):
        closer = _laid(position_m, CLOSER * apart_m)
        if closer is None:
            break
        node_m, apart_m = closer, CLOSER * apart_m
    return node_m, apart_m


def _laid(position_m: Array, spacing_m: float) -> Array | None:
    """Nodes (n, 3) within reach of an observation; None where they would be too many."""
    box_m = np.stack([position_m.min(axis=0), position_m.max(axis=0)])
    if np.prod(np.ptp(box_m, axis=0) / spacing_m + 1.0) > MOST_CANDIDATES:
        return None
    node_m = spanning_nodes(box_m, (spacing_m,) * 3)
    distance_m, _ = cKDTree(position_m).query(node_m, distance_upper_bound=REACH_M + spacing_m)
    node_m = node_m[np.isfinite(distance_m)]
    return node_m if len(node_m) <= MAX_NODES else None


def _disagree(intermediate: Sequence[ExactPosterior], node_m: Array) -> bool:
    """Whether any component's mean told at the nodes differs from the map's by more than AGREEMENT."""
    differences_uT = _differences_uT(intermediate, [interpolate(each, node_m) for each in intermediate])
    noise_sd_uT = [max(each.process.noise_sd_uT, LEAST_NOISE_UT) for each in intermediate]
    return any(d > AGREEMENT * noise for d, noise in zip(differences_uT, noise_sd_uT, strict=True))


def _differences_uT(intermediate: Sequence[ExactPosterior], maps: Sequence[ExactPosterior]) -> list[float]:
    """Root mean square difference of the means, per component, where something was observed."""
    position_m = intermediate[0].position_m
    pairs = zip(intermediate, maps, strict=True)
    return [float(np.sqrt(np.mean(np.square(a.mean_at(position_m) - b.mean_at(position_m))))) for a, b in pairs]
