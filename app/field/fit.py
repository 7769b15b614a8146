"""Samples in, map out: the one entry of the map engine."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np

from app.errors import InvalidInput
from app.field.compromise_engine import estimate_by_compromise
from app.field.conflict import quality_layers
from app.field.consistency import check_surveys
from app.field.drift import out_of_date_regions
from app.field.error_structure import ErrorStructure, as_a_pose_leaves_it, labels_err
from app.field.estimate import FieldEstimate
from app.field.exact import estimate_by_exact
from app.field.grid import FieldGrid
from app.field.hard_iron import Cleaned, HardIron, remove_hard_iron
from app.field.held_out_structure import held_out_structure
from app.field.hilbert_engine import estimate_by_hilbert
from app.field.kernels import base_kernel, is_sum
from app.field.leave_one_out import HeldOut, error_correlation_m, score
from app.field.measured import measured_cells, near_other_walks
from app.field.noise_calibration import NEW, noise_sd_by_survey
from app.field.observations import Walk, observe
from app.field.refinement import Untouched, refine
from app.field.samples import COMPONENT_NAMES, Samples
from app.field.spec import Engine, FittedMap, MapSpec, Progress
from app.field.tally import held_out_errors
from app.field.tile_fit import FitState, FitTiles, fit_one_by_one
from app.field.walk_localizability import add_localizability
from app.geometry import Array

__all__ = ["fit_map"]

_Estimator = Callable[[Sequence[Walk], Cleaned, MapSpec, FitState | None, Progress], FieldEstimate]
_WITHOUT_TILES: dict[Engine, _Estimator] = {"exact": estimate_by_exact, "compromise": estimate_by_compromise}


RELEARN = 2.0
"""What was learned is learned anew when there are this many times more, or fewer, samples, or nearly so."""
REFINING = 0.8
"""Share of the progress that refinement takes."""


def _silent(fraction: float, message: str) -> None:
    """Progress that nobody follows."""


def fit_map(
    walks: Mapping[str, Samples],
    spec: MapSpec,
    progress: Progress = _silent,
    previous: FitState | None = None,
    fit_tiles: FitTiles = fit_one_by_one,
) -> FittedMap:
    """Fit a map from the walks of its surveys (survey id -> samples); the order of the mapping does not matter.

    Survey ids sort by the time of upload: that decides which surveys are recent (`out_of_date`).

    `previous` is the state an earlier fit with the same parameters left (FittedMap.state): only tiles whose surveys
    have changed are fitted again, and the map is what a fit of everything with the same hyper-parameters gives. An id
    must stand for the same samples in both. A map of refined walks is fitted from nothing, and leaves no state: a walk
    more moves all the others.
    `fit_tiles` fits the tiles of engine hilbert, here or elsewhere.
    `progress(fraction, message)` is called often; what it raises (JobCancelled) passes through.
    Raises InvalidInput when there is too little to fit or the parameters make no map, IncompatibleFrames when a walk
    cannot give `spec.components`.
    """
    _check(spec)
    progress(0.0, "reading the walks")
    samples = sum(map(len, walks.values()))
    if spec.refine or (previous is not None and not _about_as_many(previous.learned.samples, samples)):
        previous = None
    cleaned = Cleaned(walks, HardIron(), {})
    if spec.hard_iron:
        cleaned = remove_hard_iron(walks, spec.components, previous.hard_iron if previous else HardIron())
    refining = REFINING if spec.refine else 0.0
    refinement = refine(cleaned, spec, lambda f, text: progress(refining * f, text)) if spec.refine else None
    applied = refinement if refinement is not None and refinement.worth_it else None
    if applied is not None:
        cleaned = replace(cleaned, walks=applied.walks)
    observed = observe(cleaned.walks, spec.components)
    estimator = _WITHOUT_TILES.get(spec.engine) or partial(estimate_by_hilbert, fit_tiles=fit_tiles)
    estimate = estimator(
        observed, cleaned, spec, previous, lambda f, text: progress(refining + (0.9 - refining) * f, text)
    )
    progress(0.9, "scoring the map by leaving each survey out")
    held_out, noise_sd_uT = _held_out(observed, estimate, applied.untouched if applied else {})
    correlation_m = error_correlation_m(held_out)
    scored = score(held_out, {walk.survey_id: walk.sample_field_uT for walk in observed})
    names, frame = COMPONENT_NAMES[spec.components], estimate.frame
    structure = held_out_structure(held_out)
    if labels_err(noise_sd_uT, estimate.prior_sd_uT):
        structure = as_a_pose_leaves_it(structure)
    grid = _grid(observed, estimate, spec, noise_sd_uT, correlation_m, structure)
    reports = check_surveys(held_out, names, correlation_m)
    about_labels = {"refinement": refinement.as_json()} if refinement else {}
    return FittedMap(
        grid=grid,
        hyperparameters={"engine": spec.engine} | estimate.hyperparameters | about_labels,
        score=scored,
        score_reason=None if scored else _score_reason(observed),
        consistency=add_localizability(reports, cleaned.walks, held_out, grid),
        layers=quality_layers(frame.x_m, frame.y_m, frame.heights_m, observed, held_out),
        out_of_date=out_of_date_regions(observed, held_out, sorted(walks), names, correlation_m),
        state=None if spec.refine else estimate.state,
        tiles_refitted=estimate.tiles_refitted,
        continued=estimate.continued,
        held_out=held_out,
        hard_iron=cleaned.hard_iron.as_json(),
    )


def _about_as_many(learned_from: int, now: int) -> bool:
    """Whether what was learned from so many samples still serves."""
    return learned_from / RELEARN < 0.95 * now and now <= learned_from * RELEARN


def _check(spec: MapSpec) -> None:
    """Raises InvalidInput for parameters that make no map."""
    if not spec.resolution_m > 0.0:
        raise InvalidInput(f"resolution_m is {spec.resolution_m:g}: give the side of a cell in metres, above zero")
    heights_m = spec.heights_m
    if heights_m is not None and (not heights_m or any(b - a < 0.01 for a, b in pairwise(heights_m))):
        raise InvalidInput("heights_m must be one or more heights in rising order, a centimetre apart at least")
    if spec.curl_free and spec.components != "vector":
        raise InvalidInput(f"a {spec.components} map has no curl to be free of: ask for components vector")
    if spec.curl_free and spec.engine != "hilbert":
        raise InvalidInput(f"the {spec.engine} engine has independent components: curl_free needs engine hilbert")
    if spec.curl_free and is_sum(spec.covariance):
        raise InvalidInput(
            f"the potential of a curl-free map has one length: ask for kernel {base_kernel(spec.covariance)}"
        )
    if spec.refine and spec.engine != "hilbert":
        raise InvalidInput(f"the {spec.engine} engine does not refine walks: refine needs engine hilbert")


def _held_out(
    walks: Sequence[Walk], estimate: FieldEstimate, untouched: Mapping[str, Untouched]
) -> tuple[dict[str, HeldOut], Array]:
    """Every survey against the map of the others, and the noise sd (c,) of one further measurement.

    untouched: of surveys whose labels were corrected by the others, which agree too well.
    """
    near = near_other_walks(walks, volume=len(estimate.gradient_uT_per_m) == 3)
    error_uT, needed_uT2, latent_uT2, place = {}, {}, {}, {}
    for walk in walks:
        name = walk.survey_id
        if name in untouched:
            predicted_uT, latent_uT2[name] = untouched[name]
            place[name] = np.arange(len(predicted_uT))
        else:
            predicted_uT = estimate.ambient_uT + estimate.held_out_mean_uT[name]
            latent_uT2[name] = estimate.held_out_variance_ratio[name] * np.square(estimate.prior_sd_uT)
            place[name] = walk.stretch_of_sample
        error_uT[name], needed_uT2[name] = held_out_errors(
            walk.sample_field_uT, predicted_uT, latent_uT2[name], place[name], near[name]
        )
    scatter_uT2 = np.mean([walk.scatter_uT2 for walk in walks], axis=0)
    believed_sd_uT = np.sqrt(np.square(estimate.error_sd_uT) + scatter_uT2)
    nothing = np.zeros((0, len(believed_sd_uT)))
    shown = {name: nothing if name in estimate.discredited else needed for name, needed in needed_uT2.items()}
    shown_sd_uT = noise_sd_by_survey({**shown, NEW: nothing}, believed_sd_uT)
    held_out = {
        name: HeldOut(
            error_uT=error_uT[name],
            sd_uT=np.sqrt(latent_uT2[name] + np.square(shown_sd_uT[name])).take(place[name], axis=0),
            judged=near[name],
            path_m=walk.path_m.take(walk.stretch_of_sample),
        )
        for name, walk in ((walk.survey_id, walk) for walk in walks)
    }
    return held_out, shown_sd_uT[NEW]


def _grid(
    walks: Sequence[Walk],
    estimate: FieldEstimate,
    spec: MapSpec,
    noise_sd_uT: Array,
    correlation_m: float,
    structure: ErrorStructure,
) -> FieldGrid:
    """Layers of cells, cells first and components last."""
    frame = estimate.frame
    sd_uT = np.sqrt(np.moveaxis(estimate.variance_ratio, 0, -1)) * estimate.prior_sd_uT
    return FieldGrid(
        components=spec.components,
        origin_m=(float(frame.x_m[0]), float(frame.y_m[0])),
        resolution_m=spec.resolution_m,
        heights_m=frame.heights_m,
        mean_uT=(np.moveaxis(estimate.mean_uT, 0, -1) + estimate.ambient_uT).astype(np.float32),
        sd_uT=sd_uT.astype(np.float32),
        gradient_uT_per_m=np.ascontiguousarray(estimate.gradient_uT_per_m.transpose(2, 3, 4, 1, 0), np.float32),
        measured=measured_cells(frame, walks, spec.resolution_m, estimate),
        ambient_uT=estimate.ambient_uT,
        prior_sd_uT=np.ascontiguousarray(estimate.prior_sd_uT),
        noise_sd_uT=noise_sd_uT,
        error_correlation_m=correlation_m,
        error_structure=structure,
    )


def _score_reason(walks: Sequence[Walk]) -> str:
    if len(walks) == 1:
        return "a single survey cannot be left out: add a second walk over the same places"
    return "no two surveys come within a metre of each other: walk some places twice"
