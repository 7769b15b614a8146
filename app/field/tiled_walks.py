"""Walks cut up by the tiles of a lattice."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from app.field.observations import Walk, walk_bounds
from app.field.statistics import SurveyStatistics, survey_statistics
from app.field.tiles import Lattice, Tile
from app.field.walk_noise import WalkNoise
from app.geometry import Array

__all__ = ["TiledWalks"]


class TiledWalks:
    """The observations of all walks one after the other, and which of them every tile is fitted from."""

    def __init__(self, lattice: Lattice, walks: Sequence[Walk], ambient_uT: Array) -> None:
        self.lattice = lattice
        self._survey_ids = [walk.survey_id for walk in walks]
        self._bounds = walk_bounds(walks)
        self._points_m = np.concatenate([walk.position_m[:, :2] for walk in walks])
        self._path_m = np.concatenate([walk.path_m for walk in walks])
        self._deviation_uT = np.concatenate([walk.field_uT for walk in walks]) - ambient_uT
        worth_fitting = lattice.reached(self._points_m)
        fitting = lattice.fitting(self._points_m)
        self._members = {tile: inside for tile, inside in fitting.items() if tile in worth_fitting}

    def counts(self) -> dict[Tile, int]:
        """Tile -> observations it is fitted from, in order of tile."""
        return {tile: len(inside) for tile, inside in self._members.items()}

    def statistics(self, tile: Tile, noise: WalkNoise) -> dict[str, SurveyStatistics]:
        """Survey id -> statistics of the surveys that cross the tile, in the walks' order."""
        basis = self.lattice.basis(tile)
        return {
            self._survey_ids[survey]: survey_statistics(
                basis, self._points_m[inside], self._deviation_uT[inside], self._path_m[inside], noise
            )
            for survey, inside in self._by_survey(self._members[tile])
        }

    def _by_survey(self, members: NDArray[np.int64]) -> list[tuple[int, NDArray[np.int64]]]:
        cuts = np.searchsorted(members, self._bounds).tolist()
        return [(survey, members[start:stop]) for survey, (start, stop) in enumerate(pairwise(cuts)) if stop > start]
