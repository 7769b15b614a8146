"""The default engine: learn on a few tiles, then one pass over all of them, one tile in memory at a time.

A map that has been fitted before leaves what was learned and the fits of its tiles; with the same surveys a tile is
taken from there. Adding, leaving out or deleting a survey so costs the tiles it crosses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.field.continuation import in_terms_of, spread_uT, with_continuation
from app.field.estimate import FieldEstimate, ambient_field_uT
from app.field.hard_iron import Cleaned
from app.field.held_out_choice import choose_by_held_out_surveys
from app.field.interpolation import interpolation_ratio
from app.field.learning import learn
from app.field.leave_one_out import HeldOutPrediction
from app.field.observations import Walk
from app.field.potential import blend_potentials
from app.field.raster import Blended, GridFrame, blend, layer_heights_m, on_all_layers, reach_up_m, reachable
from app.field.spec import MapSpec, Progress
from app.field.survey_noise import clearly_differ, survey_noise_scales
from app.field.tile_fit import FitState, FitTiles, Learned, TileFit, TileOrder, fit_one_by_one
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Heights, Lattice, Slab, Tile
from app.geometry import Array

__all__ = ["estimate_by_hilbert"]

FLAT_M = 0.8
"""Walks whose heights (5th to 95th percentile) differ by less are taken to be at one height."""
DISCREDITED = 10.0
"""A survey this many times noisier than the others says nothing of the ambient field, nor of the next one's errors."""
NOISE_ROUNDS = 2
"""How often the noise of single surveys is learned, and everything else with it; most maps need none."""


class _Fit(NamedTuple):
    """The tiles of a lattice, what they were fitted with, and every walk predicted from the others.

    answered (nz,): layers the tiles hold; coarse_ratio: variance, over the signal's, that the grid loses between cells.
    """

    learned: Learned
    frame: GridFrame
    answered: NDArray[np.bool_]
    coarse_ratio: float
    tiles: dict[Tile, TileFit]
    predicted: HeldOutPrediction


def estimate_by_hilbert(
    walks: Sequence[Walk],
    cleaned: Cleaned,
    spec: MapSpec,
    previous: FitState | None,
    progress: Progress,
    fit_tiles: FitTiles = fit_one_by_one,
) -> FieldEstimate:
    """The blended field of all tiles, and the walks predicted by subtraction. Raises InvalidInput for a huge grid."""
    layers_m = layer_heights_m(walks, spec)
    slab = _slab(walks, spec, layers_m)
    if previous is not None and not _fits(previous.learned.lattice.slab, slab):
        previous = None
    old = previous.tiles if previous is not None and np.array_equal(previous.heights_m, layers_m) else {}

    def learned_with(noise_scale: Mapping[str, float]) -> Learned:
        ambient_uT = ambient_field_uT([walk for walk in walks if noise_scale[walk.survey_id] < DISCREDITED])
        learned = learn(walks, ambient_uT, spec, slab, lambda f, text: progress(0.3 * f, text), noise_scale)
        learned = choose_by_held_out_surveys(walks, learned, spec, lambda f, text: progress(0.3 + 0.1 * f, text))
        return _with_offsets(learned, cleaned.offset_variance_uT2)

    def fitted(learned: Learned, kept: Mapping[Tile, TileFit]) -> _Fit:
        return _fitted(walks, learned, spec, layers_m, kept, fit_tiles, lambda f, text: progress(0.4 + 0.6 * f, text))

    if previous is not None:
        before = _with_offsets(previous.learned, cleaned.offset_variance_uT2)
        fit = fitted(before, old)
        learned = _with_noise_of_new(fit, walks)
        kept = {tile: each for tile, each in fit.tiles.items() if _as_noisy(each, before, learned)}
        fit = fitted(learned, kept) if len(kept) < len(fit.tiles) else fit._replace(learned=learned)
    else:
        fit = fitted(learned_with(dict.fromkeys((walk.survey_id for walk in walks), 1.0)), old)
        for _ in range(NOISE_ROUNDS):
            noise_scale = fit.learned.hyper.noise_scale | survey_noise_scales(fit.learned, walks, fit.predicted)
            if not clearly_differ(fit.learned.hyper.noise_scale, noise_scale):
                break
            fit = fitted(learned_with(noise_scale), {})
    return _estimate(fit, walks, cleaned, spec, layers_m, previous is not None, old)


def _fitted(
    walks: Sequence[Walk],
    learned: Learned,
    spec: MapSpec,
    layers_m: Array,
    kept: Mapping[Tile, TileFit],
    fit_tiles: FitTiles,
    progress: Progress,
) -> _Fit:
    """Every tile, in order; those of `kept` that the same surveys cross are taken as they are."""
    frame = GridFrame.around(walks, spec.resolution_m, learned.hyper.length_m, layers_m)
    coarse_ratio = interpolation_ratio(learned.hyper.finest_length_m, spec.resolution_m)
    answered = _answered(walks, spec, layers_m)
    tiled = TiledWalks(learned.lattice, walks, learned.ambient_uT)
    wanted = list(tiled.counts())
    fits = {tile: kept[tile] for tile in wanted if tile in kept and kept[tile].surveys == tiled.crossing(tile)}
    missing = [tile for tile in wanted if tile not in fits]
    order = TileOrder(tiled, learned, spec.resolution_m, layers_m[answered], spec.robust, missing)
    fits.update(fit_tiles(order, progress))
    tiles = {tile: fits[tile] for tile in wanted}
    predicted = HeldOutPrediction(learned.lattice, walks, len(next(iter(tiles.values())).patch.variance_ratio))
    for tile, fit in tiles.items():
        predicted.add(tile, tiled.all_answered(tile), fit.held_out)
    return _Fit(learned, frame, answered, coarse_ratio, tiles, predicted)


def _with_noise_of_new(fit: _Fit, walks: Sequence[Walk]) -> Learned:
    """What was learned, with the noise of surveys that came since; those of before keep theirs."""
    hyper = fit.learned.hyper
    present = [walk.survey_id for walk in walks]
    found = {}
    if any(name not in hyper.noise_scale for name in present):
        found = survey_noise_scales(fit.learned, walks, fit.predicted)
    noise_scale = {name: hyper.noise_scale.get(name, found.get(name, 1.0)) for name in present}
    return replace(fit.learned, hyper=replace(hyper, noise_scale=noise_scale))


def _as_noisy(fit: TileFit, before: Learned, after: Learned) -> bool:
    """Whether the surveys of a tile are as noisy as they were taken to be."""
    return all(before.hyper.noise_scale.get(name, 1.0) == after.hyper.noise_scale[name] for name in fit.surveys)


def _estimate(
    fit: _Fit,
    walks: Sequence[Walk],
    cleaned: Cleaned,
    spec: MapSpec,
    layers_m: Array,
    continued: bool,
    old: Mapping[Tile, TileFit],
) -> FieldEstimate:
    learned, frame, answered, coarse_ratio, tiles, predicted = fit
    lattice, hyper = learned.lattice, learned.hyper
    blended = _blend(lattice, replace(frame, heights_m=layers_m[answered]), spec, tiles)
    components = len(learned.ambient_uT)
    prior_sd_uT, error_sd_uT = (np.broadcast_to(sd, components) for sd in (hyper.signal_sd_uT, hyper.error_sd_uT))
    blended = blended._replace(variance_ratio=np.minimum(blended.variance_ratio + coarse_ratio, 1.0))
    variance_ratio, held_out_ratio = blended.variance_ratio, predicted.variance_ratio
    if spec.curl_free:
        prior_sd_uT = spread_uT(walks, learned.ambient_uT)
        in_prior = np.square(hyper.signal_sd_uT / prior_sd_uT)
        variance_ratio = in_terms_of(
            in_prior, with_continuation(blended, layers_m[answered], walks, hyper.signal_sd_uT)
        )
        held_out_ratio = {name: in_terms_of(in_prior, ratio.T).T for name, ratio in held_out_ratio.items()}
    return FieldEstimate(
        frame=frame,
        ambient_uT=learned.ambient_uT,
        mean_uT=on_all_layers(blended.mean_uT, answered, 0.0),
        variance_ratio=on_all_layers(variance_ratio, answered, 1.0),
        gradient_uT_per_m=on_all_layers(blended.gradient_uT_per_m, answered, 0.0),
        prior_sd_uT=prior_sd_uT,
        error_sd_uT=error_sd_uT,
        held_out_mean_uT=predicted.mean_uT,
        held_out_variance_ratio=held_out_ratio,
        reach_up_m=reach_up_m(spec),
        hyperparameters=hyper.as_json() | {"tile_pitch_m": lattice.pitch_m},
        discredited=frozenset(name for name, scale in hyper.noise_scale.items() if scale >= DISCREDITED),
        state=FitState(learned, layers_m, cleaned.hard_iron, tiles),
        continued=continued,
        tiles_refitted=sum(each is not old.get(tile) for tile, each in tiles.items()),
    )


def _blend(lattice: Lattice, frame: GridFrame, spec: MapSpec, tiles: Mapping[Tile, TileFit]) -> Blended:
    patches = {tile: fit.patch for tile, fit in tiles.items()}
    if not spec.curl_free:
        return blend(lattice, frame, spec.resolution_m, patches)
    borders = {tile: fit.borders for tile, fit in tiles.items()}
    return blend_potentials(lattice, frame, spec.resolution_m, patches, borders)


def _with_offsets(learned: Learned, offset_variance_uT2: Mapping[str, Array]) -> Learned:
    """With what may be left of every sensor's own field, beside the signal."""
    signal_uT2 = float(np.mean(np.square(learned.hyper.signal_sd_uT)))
    ratio = {name: float(np.mean(variance)) / signal_uT2 for name, variance in sorted(offset_variance_uT2.items())}
    return replace(learned, hyper=replace(learned.hyper, offset_ratio=ratio))


def _answered(walks: Sequence[Walk], spec: MapSpec, layers_m: Array) -> NDArray[np.bool_]:
    """(nz,) layers to fit: all of a plane; in three dimensions those that are near enough to what was walked."""
    z_m = np.concatenate([walk.position_m[:, 2] for walk in walks])
    return reachable(layers_m, z_m, reach_up_m(spec))


def _slab(walks: Sequence[Walk], spec: MapSpec, layers_m: Array) -> Heights | None:
    """The heights that were walked, and those that are to be answered as well; None when a plane will do."""
    z_m = np.concatenate([walk.position_m[:, 2] for walk in walks])
    low_m, high_m = np.quantile(z_m, [0.05, 0.95])
    if not spec.curl_free and len(layers_m) == 1 and high_m - low_m < FLAT_M:
        return None
    walked_m = float(z_m.min()), float(z_m.max())
    held_m = np.append(layers_m[_answered(walks, spec, layers_m)], walked_m)
    return Heights(walked_m, (float(held_m.min()), float(held_m.max())))


def _fits(slab: Slab | None, heights: Heights | None) -> bool:
    """Whether tiles that were made for a plane, or for some heights, serve these."""
    if slab is None or heights is None:
        return slab is None and heights is None
    return slab.inner_m[0] <= heights.held_m[0] and heights.held_m[1] <= slab.inner_m[1]
