"""Learning the hyper-parameters of a map on a few of its tiles."""

from collections.abc import Mapping, Sequence

import numpy as np

from app.field.hyperparameters import Hyperparameters
from app.field.marginal_likelihood import START_LOG, TileStatistics, learn
from app.field.observations import Walk
from app.field.spec import Kernel, Progress
from app.field.statistics import TiledWalks
from app.field.tiles import Lattice, Tile
from app.field.walk_noise import WHITE
from app.geometry import Array

__all__ = ["learn_hyperparameters"]

LEARNING_TILES = 6
LEARNING_FUNCTIONS = 14
ROUNDS = 6
FINEST, COARSEST = 8.0, 1.5
"""A tile can tell lengths between an eighth of its pitch (its functions) and two thirds of it (its size)."""


def learn_hyperparameters(
    walks: Sequence[Walk], ambient_uT: Array, kernel: Kernel, progress: Progress
) -> tuple[Hyperparameters, Lattice]:
    """Maximum marginal likelihood on a few well-walked tiles, on the lattice that suits the length it finds."""
    log_parameters = START_LOG
    lattice = Lattice.for_length(float(np.exp(START_LOG[0])))
    for turn in range(ROUNDS):
        progress(turn / ROUNDS, "learning hyper-parameters")
        few = Lattice(lattice.pitch_m, functions_per_axis=LEARNING_FUNCTIONS)
        tiles = _tile_statistics(few, walks, ambient_uT)
        reach_m = (lattice.pitch_m / FINEST, lattice.pitch_m / COARSEST)
        hyper, log_parameters, _ = learn(tiles, kernel, WHITE, log_parameters, reach_m, pin_bias=len(walks) == 1)
        suited = Lattice.for_length(hyper.length_m)
        if suited == lattice:
            break
        lattice = suited
    return hyper, lattice


def _tile_statistics(lattice: Lattice, walks: Sequence[Walk], ambient_uT: Array) -> list[TileStatistics]:
    tiled = TiledWalks(lattice, walks, ambient_uT)
    chosen = _well_walked(tiled.counts())
    return [TileStatistics(lattice.basis(tile), tiled.statistics(tile, WHITE)) for tile in chosen]


def _well_walked(counts: Mapping[Tile, int]) -> list[Tile]:
    """Of the tiles in the upper half by number of observations, a few spread evenly over the lattice."""
    by_count = sorted(counts, key=lambda tile: (-counts[tile], tile))
    upper = sorted(by_count[: max(LEARNING_TILES, len(by_count) // 2)])
    picks = np.unique(np.linspace(0, len(upper) - 1, LEARNING_TILES).round().astype(int))
    return [upper[pick] for pick in picks]
