"""Learning the hyper-parameters of a map on a few of its tiles.

First kernel length, white noise and survey offsets, on the lattice that suits the length they find; then the shape of
the errors along a walk, one after the other of its two parameters: each trial whitens the walks anew and learns the
rest from the statistics, starting where the nearest trial ended, with the curvature found there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace
from types import MappingProxyType

import numpy as np

from app.field.kernels import base_kernel
from app.field.marginal_likelihood import START_LOG, TOLERANCE, MostLikely, TileStatistics
from app.field.marginal_likelihood import learn as most_likely
from app.field.observations import Walk
from app.field.spec import BaseKernel, Kernel, MapSpec, Progress
from app.field.statistics import SurveyStatistics
from app.field.tile_fit import Learned
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Heights, Lattice, Tile
from app.field.walk_noise import WHITE, WalkNoise
from app.geometry import Array

__all__ = ["learn"]

LEARNING_TILES = (6, 10)
"""At least and at most; in between, one in `TILES_PER_LEARNING_TILE` of the tiles walked."""
TILES_PER_LEARNING_TILE = 12
LEARNING_FUNCTIONS: dict[BaseKernel, int] = {"squared_exponential": 15, "matern52": 14, "matern32": 14}
WIDER_TO_LEARN = 1.1
"""Than a tile is fitted: the wider, the better offsets and long errors are told from the field."""
ROUNDS = 6
LEARNING_SLABS = (4, 6)
LEARNABLE = (8.0, 1.0)
"""A tile can tell lengths between an eighth of its pitch (its functions are no finer) and all of it (its size)."""
LEARNABLE_IN_SLAB = 4.0
LONGEST_IN_SLAB = 0.3
GOOD_ENOUGH_SLAB = 2.6
CRAMPED = 1.05
"""A length this near to the least a lattice can tell would be shorter if it could."""
SHORTER_POTENTIAL = 0.92
"""Where a potential bends most it has less than the likeliest length: maps of analytic buildings, surveyed at one
height, are best at about this share of it, and their sds are honest. Several heights tell more."""
ONE_HEIGHT_M = 0.4
START_IN_SLAB_M = 1.0
"""Boxes have few functions to spare: too coarse ones make a rough field look smooth, too fine ones only cost."""
LARGE_OFFSET = 0.01
"""Above this share of the signal's variance offsets and correlated errors are worth wide tiles, to be told from it."""
GOOD_ENOUGH = 1.7
"""A lattice whose pitch is within this factor of the suited one learns the same length."""

TRIED_FIRST = (WalkNoise(variance_ratio=0.3, length_m=1.5), WalkNoise(variance_ratio=10.0, length_m=5.0))
ROUGH_TOLERANCE = 1e-3
"""What is still less likely than white noise when an iteration gains less than this is not followed further."""
WORTH_NATS = 0.02
"""Errors are taken to be correlated along a walk when that gains this log likelihood per observation and component."""
MAX_TRIALS = 10
"""Along one of them."""
WALK_NOISE_BOUNDS_LOG = np.log([(1e-2, 0.5), (1e4, 25.0)])
"""Of the variance ratio and the length in metres: what varies faster or slower is white noise, or an offset."""
STEPS_LOG = (float(np.log(4.0)), float(np.log(2.0)))


def _start_with(found: MostLikely, noise: WalkNoise) -> Array:
    """The parameters to start from with another shape of noise: white and correlated error keep their sum."""
    own = found.hyper.walk_ratio / found.hyper.white_ratio
    start = found.log_parameters.copy()
    start[1] += np.log1p(own) - np.log1p(noise.variance_ratio)
    return start


class _Learner:
    """A few well-walked tiles of one lattice, to learn on."""

    def __init__(
        self,
        lattice: Lattice,
        walks: Sequence[Walk],
        ambient_uT: Array,
        kernel: Kernel,
        noise_scale: Mapping[str, float],
    ) -> None:
        self._kernel = kernel
        self._noise_scale = noise_scale
        self._pin_bias = len(walks) == 1
        finest = LEARNABLE[0] if lattice.slab is None else LEARNABLE_IN_SLAB
        longest = LEARNABLE[1] if lattice.slab is None else LONGEST_IN_SLAB
        self._length_bounds_m = (lattice.pitch_m / finest, lattice.pitch_m / longest)
        self._tiled = TiledWalks(lattice, walks, ambient_uT)
        self._chosen = _well_walked(self._tiled.counts(), LEARNING_TILES if lattice.slab is None else LEARNING_SLABS)

    def learn(
        self, noise: WalkNoise, start_log: Array, curvature: Array | None = None, tolerance: float = TOLERANCE
    ) -> MostLikely:
        tiles = [
            TileStatistics.of(self._tiled.lattice.basis(tile), self._scaled(self._tiled.statistics(tile, noise)))
            for tile in self._chosen
        ]
        return most_likely(
            tiles, self._kernel, noise, start_log, self._length_bounds_m, self._pin_bias, tolerance, curvature
        )

    def _scaled(self, surveys: Mapping[str, SurveyStatistics]) -> list[SurveyStatistics]:
        """Every survey's statistics under its own noise."""
        return [survey.scaled(self._noise_scale.get(name, 1.0)) for name, survey in surveys.items()]


def learn(
    walks: Sequence[Walk],
    ambient_uT: Array,
    spec: MapSpec,
    slab: Heights | None,
    progress: Progress,
    noise_scale: Mapping[str, float] = MappingProxyType({}),
) -> Learned:
    """Maximum marginal likelihood, and the lattice that suits the length found; a slab is learned from its walks,

    whatever heights are to be answered. noise_scale: survey id -> factor on the variances of its errors.
    """
    kernel = spec.covariance

    def learning_lattice(length_m: float) -> Lattice:
        if slab is not None:
            return Lattice.of_slabs(kernel, length_m, slab.walked_m, spec.curl_free)
        suited = Lattice.for_length(kernel, WIDER_TO_LEARN * length_m, wide=True)
        return replace(suited, functions_per_axis=LEARNING_FUNCTIONS[base_kernel(kernel)])

    start_log = START_LOG.copy()
    if slab is not None:
        start_log[0] = np.log(START_IN_SLAB_M)
    lattice = learning_lattice(float(np.exp(start_log[0])))
    good_enough, finest = (GOOD_ENOUGH, LEARNABLE[0]) if slab is None else (GOOD_ENOUGH_SLAB, LEARNABLE_IN_SLAB)
    for turn in range(ROUNDS):
        progress(0.5 * turn / ROUNDS, "learning length and noise")
        learner = _Learner(lattice, walks, ambient_uT, kernel, noise_scale)
        found = learner.learn(WHITE, start_log)
        start_log = found.log_parameters
        suited = learning_lattice(found.hyper.finest_length_m)
        cramped = found.hyper.finest_length_m < CRAMPED * lattice.pitch_m / finest
        if not cramped and 1.0 / good_enough <= suited.pitch_m / lattice.pitch_m <= good_enough:
            break
        lattice = suited
    if spec.noise == "walk":
        found = _learn_walk_noise(learner, found, progress)
    hyper = replace(found.hyper, noise_scale=dict(noise_scale))
    if spec.curl_free and slab is not None and slab.walked_m[1] - slab.walked_m[0] < ONE_HEIGHT_M:
        hyper = replace(hyper, length_m=SHORTER_POTENTIAL * hyper.length_m)
    if slab is not None:
        lattice = Lattice.of_slabs(kernel, hyper.finest_length_m, slab.walked_m, spec.curl_free, slab.held_m)
    else:
        wide = hyper.short_length_m is not None or hyper.bias_ratio + hyper.walk_ratio > LARGE_OFFSET
        lattice = Lattice.for_length(kernel, hyper.finest_length_m, wide)
    return Learned(hyper, lattice, ambient_uT, sum(len(walk.sample_field_uT) for walk in walks))


def _learn_walk_noise(learner: _Learner, white: MostLikely, progress: Progress) -> MostLikely:
    """The best of white noise and correlated noise of any strength and length."""
    rough = [learner.learn(noise, _start_with(white, noise), white.curvature, ROUGH_TOLERANCE) for noise in TRIED_FIRST]
    tried, noise = min(zip(rough, TRIED_FIRST, strict=True), key=lambda pair: pair[0].nats)
    if tried.nats > white.nats:
        return white
    best = learner.learn(noise, tried.log_parameters, tried.curvature)
    if best.nats > white.nats - WORTH_NATS:
        return white
    point = np.log(astuple(noise))
    for axis, step in enumerate(STEPS_LOG):
        point, best = _best_along(learner, axis, step, point, best, progress)
    return best


def _best_along(
    learner: _Learner, axis: int, step: float, point: Array, best: MostLikely, progress: Progress
) -> tuple[Array, MostLikely]:
    """Steps of log variance ratio (axis 0) or log length until the best is between two worse, then the parabola."""
    direction = np.eye(2)[axis]
    least, most = np.ceil((WALK_NOISE_BOUNDS_LOG[:, axis] - point[axis]) / step)
    tried = {0.0: best}

    def try_at(steps: float) -> None:
        progress(0.5 + 0.25 * (axis + len(tried) / MAX_TRIALS), "learning the errors along a walk")
        noise = WalkNoise(*np.exp(point + steps * step * direction).tolist())
        nearest = tried[min(tried, key=lambda known: abs(known - steps))]
        tried[steps] = learner.learn(noise, _start_with(nearest, noise), nearest.curvature)

    while len(tried) < MAX_TRIALS - 1:
        middle = min(tried, key=lambda steps: tried[steps].nats)
        missing = [steps for steps in (middle + 1.0, middle - 1.0) if steps not in tried and least < steps < most]
        if not missing:
            break
        try_at(missing[0])
    if middle - 1.0 in tried and middle + 1.0 in tried:
        before, at, after = (tried[middle + steps].nats for steps in (-1.0, 0.0, 1.0))
        if before + after > 2.0 * at:
            try_at(middle + 0.5 * (before - after) / (before - 2.0 * at + after))
    best_steps = min(tried, key=lambda steps: tried[steps].nats)
    return point + best_steps * step * direction, tried[best_steps]


def _well_walked(counts: Mapping[Tile, int], least_and_most: tuple[int, int]) -> list[Tile]:
    """Of the tiles in the upper half by number of observations, a few spread evenly over the lattice."""
    by_count = sorted(counts, key=lambda tile: (-counts[tile], tile))
    wanted = int(np.clip(len(counts) // TILES_PER_LEARNING_TILE, *least_and_most))
    upper = sorted(by_count[: max(wanted, len(by_count) // 2)])
    picks = np.unique(np.linspace(0, len(upper) - 1, wanted).round().astype(int))
    return [upper[pick] for pick in picks]
