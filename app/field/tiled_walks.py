"""Walks cut up by the tiles of a lattice."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.field.hyperparameters import Hyperparameters
from app.field.observations import Walk
from app.field.statistics import Evidence, SurveyStatistics, marginalise, survey_statistics
from app.field.tiles import Lattice, Tile
from app.field.walk_noise import WalkNoise
from app.geometry import Array

__all__ = ["Part", "TiledWalks"]


class Part(NamedTuple):
    """One survey in one tile: positions (n, 3), features about the ambient (n, c), distance walked (n,)."""

    points_m: Array
    deviation_uT: Array
    path_m: Array


class TiledWalks:
    """The observations of all walks one after the other, and which of them every tile is fitted from and answers."""

    def __init__(self, lattice: Lattice, walks: Sequence[Walk], ambient_uT: Array) -> None:
        self.lattice = lattice
        self.walks = walks
        self._survey_ids = [walk.survey_id for walk in walks]
        self._owner = np.repeat(np.arange(len(walks)), [len(walk) for walk in walks])
        self.points_m = np.concatenate([walk.position_m for walk in walks])
        self._path_m = np.concatenate([walk.path_m for walk in walks])
        self._deviation_uT = np.concatenate([walk.field_uT for walk in walks]) - ambient_uT
        worth_fitting = lattice.reached(self.points_m)
        fitting = lattice.fitting(self.points_m)
        self._members = {tile: inside for tile, inside in fitting.items() if tile in worth_fitting}
        self._answered = lattice.answering(self.points_m)

    def counts(self) -> dict[Tile, int]:
        """Tile -> observations it is fitted from, in order of tile."""
        return {tile: len(inside) for tile, inside in self._members.items()}

    def crossing(self, tile: Tile) -> tuple[str, ...]:
        """The surveys a tile is fitted from, in the walks' order."""
        owner = self._owner[self._members[tile]]
        first = np.append(0, np.flatnonzero(owner[1:] != owner[:-1]) + 1)
        return tuple([self._survey_ids[survey] for survey in owner[first].tolist()])

    def parts(self, tile: Tile) -> dict[str, Part]:
        """Survey id -> what it measured in the tile, in the walks' order."""
        return {
            survey_id: Part(self.points_m[inside], self._deviation_uT[inside], self._path_m[inside])
            for survey_id, inside in self._by_survey(self._members[tile]).items()
        }

    def statistics(
        self, tile: Tile, noise: WalkNoise, white_scales: Mapping[str, Array] | None = None
    ) -> dict[str, SurveyStatistics]:
        """Survey id -> statistics of the surveys that cross the tile, in the walks' order."""
        basis = self.lattice.basis(tile)
        return {
            survey_id: survey_statistics(basis, *part, noise, white_scales[survey_id] if white_scales else None)
            for survey_id, part in self.parts(tile).items()
        }

    def evidence(
        self, tile: Tile, hyper: Hyperparameters, white_scales: Mapping[str, Array] | None = None
    ) -> dict[str, Evidence]:
        """Survey id -> its statistics with the offsets integrated out, in the walks' order."""
        basis = self.lattice.basis(tile)
        surveys = self.statistics(tile, hyper.walk_noise_in(basis), white_scales)
        return {name: marginalise(basis, name, survey, hyper) for name, survey in surveys.items()}

    def answered(self, tile: Tile) -> dict[str, NDArray[np.int64]]:
        """Survey id -> indices among all observations of those at which the tile has a weight."""
        return self._by_survey(self.all_answered(tile))

    def all_answered(self, tile: Tile) -> NDArray[np.int64]:
        """The same of all surveys, one after the other."""
        return self._answered.get(tile, np.zeros(0, dtype=np.int64))

    def _by_survey(self, members: NDArray[np.int64]) -> dict[str, NDArray[np.int64]]:
        owner = self._owner[members]
        cuts = [0, *(np.flatnonzero(owner[1:] != owner[:-1]) + 1).tolist(), len(members)]
        return {self._survey_ids[owner[start]]: members[start:stop] for start, stop in pairwise(cuts) if stop > start}
