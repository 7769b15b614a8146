"""The fit of one tile: its field on the raster, and every survey that crosses it predicted from the others.

It depends on the hyper-parameters and on what the surveys that cross the tile measured in it, and on nothing else: as
long as those are the same surveys the fit is the same, bit for bit, and need not be made again.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.field.hard_iron import HardIron
from app.field.hilbert import Patch, SlabPosterior, posterior, predict
from app.field.hyperparameters import Hyperparameters
from app.field.raster import tile_cells
from app.field.robust import student_evidence
from app.field.spec import Progress
from app.field.statistics import Evidence, add_evidence
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Lattice, Tile
from app.geometry import Array

__all__ = ["FitState", "FitTiles", "HeldOutPart", "Learned", "TileFit", "TileOrder", "fit_one_by_one", "fit_tile"]


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """What all tiles share: hyper-parameters, the lattice that suits them, the ambient field (c,).

    samples: how many they were learned from.
    """

    hyper: Hyperparameters
    lattice: Lattice
    ambient_uT: Array
    samples: int


class HeldOutPart(NamedTuple):
    """The observations a tile answers, one survey after the other, each from the others: mean (n, c) about the ambient,

    variance over the signal's (n, v).
    """

    mean_uT: Array
    variance_ratio: Array


@dataclass(frozen=True, slots=True, eq=False)
class TileFit:
    """surveys: those the tile was fitted from; patch: the field on the cells it answers; held_out: of no observation

    where there is a single survey; borders (2, 4, n): the potential (uT m) along the borders of the core and the
    field's variance there over the signal's, to match with the neighbours'; empty when there is no potential.
    """

    surveys: tuple[str, ...]
    patch: Patch
    held_out: HeldOutPart
    borders: Array


@dataclass(frozen=True, slots=True, eq=False)
class FitState:
    """What a fit leaves behind for the next one with the same parameters."""

    learned: Learned
    heights_m: Array
    hard_iron: HardIron
    tiles: Mapping[Tile, TileFit]


@dataclass(frozen=True, slots=True, eq=False)
class TileOrder:
    """Tiles to be fitted, with what all of them need: walks cut up by the lattice of `learned`, the raster's cell, its

    heights (nz,), and whether outliers are weighted down.
    """

    walks: TiledWalks
    learned: Learned
    resolution_m: float
    heights_m: Array
    robust: bool
    tiles: Sequence[Tile]

    def fit(self, tile: Tile) -> TileFit:
        """The fit of one of the tiles, the same wherever and whenever it is made."""
        return fit_tile(self.walks, tile, self.learned, self.resolution_m, self.heights_m, self.robust)


FitTiles = Callable[[TileOrder, Progress], Iterable[tuple[Tile, TileFit]]]
"""Fits the tiles of an order, each once and in any order."""


def fit_one_by_one(order: TileOrder, progress: Progress) -> Iterable[tuple[Tile, TileFit]]:
    """The tiles of an order, one after the other, here."""
    for index, tile in enumerate(order.tiles):
        progress(index / len(order.tiles), f"fitting tile {index + 1:,} of {len(order.tiles):,}")
        yield tile, order.fit(tile)


def fit_tile(
    tiled: TiledWalks, tile: Tile, learned: Learned, resolution_m: float, heights_m: Array, robust: bool
) -> TileFit:
    """Fit one tile from the walks that cross it."""
    hyper, basis = learned.hyper, learned.lattice.basis(tile)
    evidence = student_evidence(tiled, tile, hyper) if robust else tiled.evidence(tile, hyper)
    total = add_evidence(evidence.values())
    x_m, y_m = (tile_cells(learned.lattice, axis, tile, resolution_m) for axis in (0, 1))
    fitted = posterior(basis, total, hyper, len(x_m) * len(y_m))
    borders = np.zeros((2, 4, 0))
    if isinstance(fitted, SlabPosterior) and basis.potential:
        points_m = learned.lattice.borders(tile, heights_m)
        known = np.stack([fitted.potential_uT_m(points_m), fitted.at(points_m)[1].mean(axis=1)])
        borders = known.reshape(2, 4, -1)
    held_out = _held_out(tiled, tile, learned, evidence, total)
    return TileFit(tuple(evidence), _rounded(fitted.patch(x_m, y_m, heights_m)), held_out, borders)


def _held_out(
    tiled: TiledWalks, tile: Tile, learned: Learned, evidence: Mapping[str, Evidence], total: Evidence
) -> HeldOutPart:
    """Every survey the tile answers from the others; of a single survey nothing can be said."""
    basis, answered = learned.lattice.basis(tile), tiled.answered(tile)
    if len(evidence) < 2 or not answered:
        return HeldOutPart(np.zeros((0, total.target.shape[1])), np.zeros((0, 1)))
    parts = [
        predict(basis, total - evidence[survey_id], learned.hyper, tiled.points_m[inside])
        for survey_id, inside in answered.items()
    ]
    return HeldOutPart(*(np.ascontiguousarray(np.concatenate(each)) for each in zip(*parts, strict=True)))


def _rounded(patch: Patch) -> Patch:
    """To single precision, in which a fit is kept: one that was kept and one that was not must not differ."""
    mean, gradient, variance = (values.astype(np.float32, order="C").astype(np.float64) for values in patch[:3])
    return Patch(mean, gradient, variance, patch.potential_uT_m)
