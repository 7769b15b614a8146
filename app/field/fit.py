"""Samples in, map out: the one entry of the map engine."""

from collections.abc import Mapping, Sequence

import numpy as np

from app.errors import InvalidInput
from app.field.consistency import check_consistency
from app.field.grid import FieldGrid
from app.field.hilbert import posterior
from app.field.hyperparameters import Hyperparameters
from app.field.learning import learn_hyperparameters
from app.field.leave_one_out import HeldOut, HeldOutPrediction, error_correlation_m, score
from app.field.measured import measured_cells, near_other_walks
from app.field.observations import Walk, observe
from app.field.raster import BlendedField, GridFrame
from app.field.samples import COMPONENT_NAMES, Samples
from app.field.spec import FittedMap, MapSpec, Progress
from app.field.statistics import TiledWalks, marginalise
from app.geometry import Array

__all__ = ["fit_map"]


def _silent(fraction: float, message: str) -> None:
    """Progress that nobody follows."""


def fit_map(walks: Mapping[str, Samples], spec: MapSpec, progress: Progress = _silent) -> FittedMap:
    """Fit a map from the walks of its surveys (survey id -> samples); the order of the mapping does not matter.

    `progress(fraction, message)` is called often; what it raises (JobCancelled) passes through.
    Raises InvalidInput when there is too little to fit or the parameters make no map, IncompatibleFrames when a walk
    cannot give `spec.components`.
    """
    height_m = _single_height(spec)
    progress(0.0, "reading the walks")
    observed = observe(walks, spec.components)
    return _fit_hilbert(observed, spec, height_m, progress)


def _fit_hilbert(walks: Sequence[Walk], spec: MapSpec, height_m: float | None, progress: Progress) -> FittedMap:
    """Learn on a few tiles, then one pass over all: posterior, grid cells and held-out predictions of each tile."""
    ambient_uT = np.median(np.concatenate([walk.field_uT for walk in walks]), axis=0)
    hyper, lattice = learn_hyperparameters(
        walks, ambient_uT, spec.kernel, lambda f, message: progress(0.02 + 0.28 * f, message)
    )
    frame = GridFrame.around(walks, spec.resolution_m, hyper.length_m, height_m)
    blended = BlendedField(lattice, frame, len(ambient_uT))
    predicted = HeldOutPrediction(lattice, walks, hyper)
    tiled = TiledWalks(lattice, walks, ambient_uT)
    tiles = list(tiled.counts())
    for index, tile in enumerate(tiles):
        progress(0.3 + 0.65 * index / len(tiles), f"fitting tile {index + 1} of {len(tiles)}")
        basis = lattice.basis(tile)
        white_ratio = hyper.white_ratio_in(basis)
        surveys = tiled.statistics(tile, hyper.walk_noise_in(basis))
        evidence = {name: marginalise(s, white_ratio, hyper.bias_ratio) for name, s in surveys.items()}
        total = sum(list(evidence.values())[1:], start=next(iter(evidence.values())))
        blended.add(tile, posterior(basis, total, hyper))
        predicted.add(tile, evidence, total)
    progress(0.95, "scoring the map by leaving each survey out")
    noise_sd_uT = _noise_sd_uT(walks, hyper)
    held_out = _held_out(walks, predicted, hyper, ambient_uT, noise_sd_uT)
    correlation_m = error_correlation_m(held_out)
    grid = FieldGrid(
        components=spec.components,
        origin_m=(float(frame.x_m[0]), float(frame.y_m[0])),
        resolution_m=spec.resolution_m,
        heights_m=np.array([frame.height_m]),
        mean_uT=(blended.mean_uT.transpose(1, 2, 0) + ambient_uT).astype(np.float32)[None],
        sd_uT=(np.sqrt(blended.variance_ratio)[..., None] * hyper.signal_sd_uT).astype(np.float32)[None],
        gradient_uT_per_m=np.ascontiguousarray(blended.gradient_uT_per_m.transpose(2, 3, 1, 0))[None],
        measured=measured_cells(frame, walks, spec.resolution_m, blended.variance_ratio)[None],
        ambient_uT=ambient_uT,
        prior_sd_uT=hyper.signal_sd_uT,
        noise_sd_uT=noise_sd_uT,
        error_correlation_m=correlation_m,
    )
    names = COMPONENT_NAMES[spec.components]
    scored = score(held_out)
    return FittedMap(
        grid=grid,
        hyperparameters=hyper.as_json() | {"engine": "hilbert", "tile_pitch_m": lattice.pitch_m},
        score=scored,
        score_reason=None if scored else _score_reason(walks),
        consistency={name: check_consistency(h, names, correlation_m) for name, h in held_out.items()},
    )


def _single_height(spec: MapSpec) -> float | None:
    """The one height asked for, or None for the samples' own. Raises InvalidInput."""
    if not spec.resolution_m > 0.0:
        raise InvalidInput(f"resolution_m is {spec.resolution_m:g}: give the side of a cell in metres, above zero")
    if spec.heights_m is None:
        return None
    if len(spec.heights_m) != 1:
        raise InvalidInput(
            f"heights_m asks for {len(spec.heights_m)} layers, but surveys at one height say nothing about another: "
            "give one height or none"
        )
    return spec.heights_m[0]


def _noise_sd_uT(walks: Sequence[Walk], hyper: Hyperparameters) -> Array:
    """(c,) sd of one further sample about the field: error of an observation, and scatter of samples about it."""
    scatter_uT2 = np.mean([walk.scatter_uT2 for walk in walks], axis=0)
    return np.asarray(np.sqrt(np.square(hyper.error_sd_uT) + scatter_uT2))


def _held_out(
    walks: Sequence[Walk],
    predicted: HeldOutPrediction,
    hyper: Hyperparameters,
    ambient_uT: Array,
    noise_sd_uT: Array,
) -> dict[str, HeldOut]:
    near = near_other_walks(walks)
    held_out: dict[str, HeldOut] = {}
    for walk in walks:
        name = walk.survey_id
        stretch = walk.stretch_of_sample
        variance_uT2 = np.multiply.outer(predicted.variance_ratio[name][stretch], np.square(hyper.signal_sd_uT))
        held_out[name] = HeldOut(
            error_uT=walk.sample_field_uT - ambient_uT - predicted.mean_uT[name][stretch],
            sd_uT=np.sqrt(variance_uT2 + np.square(noise_sd_uT)),
            judged=near[name],
            path_m=walk.path_m[stretch],
        )
    return held_out


def _score_reason(walks: Sequence[Walk]) -> str:
    if len(walks) == 1:
        return "a single survey cannot be left out: add a second walk over the same places"
    return "no two surveys come within a metre of each other: walk some places twice"
