"""What one survey tells one tile: sufficient statistics that add up to a map.

With basis rows Phi (n, m), features y (n, c) about the ambient field and the walk's noise shape R, the statistics are
`Phi^T R^-1 Phi`, `Phi^T R^-1 y`, `Phi^T R^-1 1`, `1^T R^-1 1`, `1^T R^-1 y`, `y^T R^-1 y`, `log det R` and n. A
survey's constant offset inside the tile, of prior variance `bias_ratio` beside a white variance `white_ratio`, is
integrated out in closed form afterwards (Sherman-Morrison), so offsets cost nothing and no sample is read again.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk

from app.field.basis import CosineBasis
from app.field.observations import Walk
from app.field.tiles import Lattice, Tile
from app.field.walk_noise import WalkNoise, whiten
from app.geometry import Array

__all__ = ["Evidence", "SurveyStatistics", "TiledWalks", "add_evidence", "marginalise", "survey_statistics"]


@dataclass(frozen=True, slots=True, eq=False)
class SurveyStatistics:
    """gram (m, m), target (m, c), offset (m,), ones, ones_target (c,), energy (c,), log_det_shape, count: see above."""

    gram: Array
    target: Array
    offset: Array
    ones: float
    ones_target: Array
    energy: Array
    log_det_shape: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Statistics with the surveys' offsets integrated out, ready to be added: gram (m, m), target (m, c)."""

    gram: Array
    target: Array

    def __sub__(self, other: "Evidence") -> "Evidence":
        return Evidence(self.gram - other.gram, self.target - other.target)


def survey_statistics(
    basis: CosineBasis, points_m: Array, deviation_uT: Array, path_m: Array, noise: WalkNoise
) -> SurveyStatistics:
    """The statistics of one walk's observations inside one tile.

    points_m (n, 2); deviation_uT (n, c) features minus the ambient field; path_m (n,) distance walked.
    """
    m = basis.size
    columns = np.empty((len(points_m), m + 1 + deviation_uT.shape[1]), order="F")
    columns[:, :m], columns[:, m], columns[:, m + 1 :] = basis.at(points_m), 1.0, deviation_uT
    white, log_det = whiten(columns, path_m, noise)
    upper = dsyrk(1.0, white, trans=1)
    products = upper + np.triu(upper, 1).T
    return SurveyStatistics(
        gram=products[:m, :m],
        target=products[:m, m + 1 :],
        offset=products[:m, m],
        ones=float(products[m, m]),
        ones_target=products[m, m + 1 :],
        energy=np.diagonal(products)[m + 1 :],
        log_det_shape=log_det,
        count=len(points_m),
    )


class TiledWalks:
    """Walks cut up by the tiles of a lattice."""

    def __init__(self, lattice: Lattice, walks: Sequence[Walk], ambient_uT: Array) -> None:
        self.lattice = lattice
        self._walks = {walk.survey_id: walk for walk in walks}
        self._ambient_uT = ambient_uT
        self._members: dict[Tile, dict[str, NDArray[np.int64]]] = {}
        worth_fitting = set().union(*(lattice.reached(walk.position_m[:, :2]) for walk in walks))
        for walk in walks:
            for tile, inside in lattice.fitting(walk.position_m[:, :2]).items():
                if tile in worth_fitting:
                    self._members.setdefault(tile, {})[walk.survey_id] = inside

    def counts(self) -> dict[Tile, int]:
        """Tile -> observations it is fitted from, in order of tile."""
        return {tile: sum(map(len, self._members[tile].values())) for tile in sorted(self._members)}

    def statistics(self, tile: Tile, noise: WalkNoise) -> dict[str, SurveyStatistics]:
        """Survey id -> statistics of the surveys that cross the tile, in the walks' order."""
        basis = self.lattice.basis(tile)
        result: dict[str, SurveyStatistics] = {}
        for survey_id, inside in self._members[tile].items():
            walk = self._walks[survey_id]
            deviation_uT = walk.field_uT[inside] - self._ambient_uT
            points_m, path_m = walk.position_m[inside, :2], walk.path_m[inside]
            result[survey_id] = survey_statistics(basis, points_m, deviation_uT, path_m, noise)
        return result


def add_evidence(evidence: Collection[Evidence]) -> Evidence:
    """The evidence of a whole tile: the sum over its surveys."""
    return Evidence(np.sum([e.gram for e in evidence], axis=0), np.sum([e.target for e in evidence], axis=0))


def marginalise(survey: SurveyStatistics, white_ratio: float, bias_ratio: float) -> Evidence:
    """The survey's evidence about the weights in units of the signal variance, its offset integrated out."""
    shrink = bias_ratio / (white_ratio + bias_ratio * survey.ones)
    gram = survey.gram - shrink * np.outer(survey.offset, survey.offset)
    target = survey.target - shrink * np.outer(survey.offset, survey.ones_target)
    return Evidence(gram / white_ratio, target / white_ratio)
