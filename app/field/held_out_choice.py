"""Kernel length and noise by the surveys left out, where errors are large.

A likelihood believes its model of the errors. Those of walks whose labels err by a metre or two are as smooth as the
field itself, which no Ornstein-Uhlenbeck process is: the likelihood then takes the field to be too rough or the errors
too long. Predictions of surveys from the others do not depend on such belief (Rasmussen & Williams 2006, 5.4.2), and
they cost a subtraction. So the most likely hyper-parameters compete with a few that suit such labels, and the ones
that predict left-out surveys best are used. The most likely have to predict clearly better, and do not compete where
they take more of the variance for errors than for the field: of such a map nothing counts as measured. Where errors
are small the likelihood is right and nothing is tried.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from app.field.leave_one_out import HeldOutPrediction
from app.field.measured import near_observations
from app.field.noise_calibration import noise_sd_by_survey
from app.field.observations import Walk, walk_bounds
from app.field.spec import MapSpec, Progress
from app.field.tile_fit import Learned, fit_tile
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Lattice
from app.geometry import Array

__all__ = ["choose_by_held_out_surveys", "held_out_nlpd"]

FEWEST_SURVEYS = 5
LARGE_ERROR, LARGE_ERROR_UT = 0.05, 0.5
"""Share of the signal's variance, and sd: below either, errors are too small for a choice to matter."""
LENGTHS_M = (5.0, 8.0)
ERROR_SHARES = (0.15, 0.3)
"""Variance of the errors along a walk (or of white ones, where those are asked for), over the signal's. Longer lengths
and larger errors predicted left-out walks of a mall a little better; but smooth maps are said to locate less well."""
WALK_LENGTH_M = 3.0
WHITE_SHARE, OFFSET_SHARE = 0.02, 0.15
WORTH_NATS = 0.01
"""By less than this, per observation and component, the most likely do not prove themselves where errors are large."""
MOST_OBSERVATIONS = 20_000
SQUARE_M = 50.0
RASTER_M = 10.0
"""The field itself is not wanted: as few cells as can be."""


def choose_by_held_out_surveys(walks: Sequence[Walk], learned: Learned, spec: MapSpec, progress: Progress) -> Learned:
    """What was learned, or hyper-parameters that predict left-out surveys better. For flat maps of one kernel."""
    hyper = learned.hyper
    flat = learned.lattice.slab is None and hyper.short_length_m is None
    share = hyper.bias_ratio + hyper.walk_ratio + hyper.white_ratio
    large = share > LARGE_ERROR and np.mean(hyper.error_sd_uT) > LARGE_ERROR_UT
    if not flat or not large or len(walks) < FEWEST_SURVEYS:
        return learned
    part = _thinned(walks)
    best, least = learned, held_out_nlpd(part, learned, spec) + WORTH_NATS if share < 1.0 else np.inf
    for step, (length_m, share) in enumerate(product(LENGTHS_M, ERROR_SHARES)):
        progress(step / len(LENGTHS_M) / len(ERROR_SHARES), "choosing length and noise by surveys left out")
        tried = _with(learned, spec, length_m, share)
        if (nlpd := held_out_nlpd(part, tried, spec)) < least:
            best, least = tried, nlpd
    return best


def held_out_nlpd(walks: Sequence[Walk], learned: Learned, spec: MapSpec) -> float:
    """Mean over observations near another survey of the NLPD of each survey predicted from the others.

    The noise is what the errors of the other surveys show (`noise_sd_by_survey`), so that a candidate is judged by the
    map it makes. Infinite when no survey comes near another.
    """
    tiled = TiledWalks(learned.lattice, walks, learned.ambient_uT)
    predicted = HeldOutPrediction(learned.lattice, walks, 1)
    for tile in tiled.counts():
        fit = fit_tile(tiled, tile, learned, RASTER_M, np.zeros(1), spec.robust)
        predicted.add(tile, tiled.all_answered(tile), fit.held_out)
    near = near_observations(walks, volume=False)
    error_uT, latent_uT2 = {}, {}
    for walk in walks:
        name = walk.survey_id
        judged = near[name]
        error_uT[name] = (walk.field_uT - learned.ambient_uT - predicted.mean_uT[name])[judged]
        latent_uT2[name] = (predicted.variance_ratio[name] * np.square(learned.hyper.signal_sd_uT))[judged]
    needed_uT2 = {name: np.square(error) / 4.0 - latent_uT2[name] for name, error in error_uT.items()}
    noise_sd_uT = noise_sd_by_survey(needed_uT2, learned.hyper.error_sd_uT)
    parts = [_nlpd(error_uT[name], latent_uT2[name] + np.square(noise_sd_uT[name])) for name in error_uT]
    each = np.concatenate(parts)
    return float(each.mean()) if len(each) else np.inf


def _nlpd(error_uT: Array, variance_uT2: Array) -> Array:
    return np.asarray(0.5 * np.mean(np.log(2.0 * np.pi * variance_uT2) + np.square(error_uT) / variance_uT2, axis=1))


def _with(learned: Learned, spec: MapSpec, length_m: float, share: float) -> Learned:
    """Another length, and the same variance in all, shared out otherwise between signal and errors."""
    correlated = spec.noise == "walk"
    was = learned.hyper
    told_apart = 1.0 + was.bias_ratio + was.walk_ratio + was.white_ratio
    shared_out = 1.0 + OFFSET_SHARE + share + (WHITE_SHARE if correlated else 0.0)
    hyper = replace(
        was,
        signal_sd_uT=was.signal_sd_uT * np.sqrt(told_apart / shared_out),
        length_m=length_m,
        white_ratio=WHITE_SHARE if correlated else share,
        walk_ratio=share if correlated else 0.0,
        walk_length_m=WALK_LENGTH_M,
        bias_ratio=OFFSET_SHARE,
    )
    return replace(learned, hyper=hyper, lattice=Lattice.for_length(hyper.kernel, length_m, wide=True))


def _thinned(walks: Sequence[Walk]) -> list[Walk]:
    """The walks without their single samples, and of a large map only what lies in some squares, evenly over it."""
    squares = [np.floor(walk.position_m[:, :2] / SQUARE_M).astype(np.int64) for walk in walks]
    _, number = np.unique(np.concatenate(squares), axis=0, return_inverse=True)
    every = -(-len(number) // MOST_OBSERVATIONS)
    kept = np.split(number.ravel() % every == 0, walk_bounds(walks)[1:-1])
    return [_cut(walk, inside) for walk, inside in zip(walks, kept, strict=True) if inside.any()]


def _cut(walk: Walk, inside: NDArray[np.bool_]) -> Walk:
    field_uT = walk.field_uT[inside]
    return replace(
        walk,
        position_m=walk.position_m[inside],
        field_uT=field_uT,
        path_m=walk.path_m[inside],
        sample_field_uT=field_uT,
        stretch_of_sample=np.arange(len(field_uT)),
    )
