"""What one survey tells one tile: sufficient statistics that add up to a map.

With basis rows Phi (n, m), features y (n, c) about the ambient field and the walk's noise shape R, the statistics are
`Phi^T R^-1 Phi`, `Phi^T R^-1 y`, `Phi^T R^-1 1`, `1^T R^-1 1`, `1^T R^-1 y`, `y^T R^-1 y`, `log det R` and n. A
survey's constant offset inside the tile, of prior variance `bias_ratio` beside a white variance `white_ratio`, is
integrated out in closed form afterwards (Sherman-Morrison), so offsets cost nothing and no sample is read again.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dsyrk

from app.field.basis import CosineBasis
from app.field.observations import Walk
from app.field.tiles import Lattice, Tile
from app.field.walk_noise import WalkNoise, whiten
from app.geometry import Array

__all__ = ["Evidence", "SurveyStatistics", "marginalise", "statistics_by_tile", "survey_statistics"]


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

    def __add__(self, other: "Evidence") -> "Evidence":
        return Evidence(self.gram + other.gram, self.target + other.target)

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


def statistics_by_tile(
    lattice: Lattice, walks: Sequence[Walk], ambient_uT: Array, noise: WalkNoise, tiles: Iterable[Tile]
) -> dict[Tile, dict[str, SurveyStatistics]]:
    """Tile -> survey id -> statistics, for the tiles asked for, in order of survey id."""
    members = {walk.survey_id: lattice.fitting(walk.position_m[:, :2]) for walk in walks}
    result: dict[Tile, dict[str, SurveyStatistics]] = {}
    for tile in tiles:
        basis = lattice.basis(tile)
        result[tile] = {}
        for walk in walks:
            inside = members[walk.survey_id].get(tile)
            if inside is not None:
                result[tile][walk.survey_id] = survey_statistics(
                    basis,
                    walk.position_m[inside, :2],
                    walk.field_uT[inside] - ambient_uT,
                    walk.path_m[inside],
                    noise,
                )
    return result


def marginalise(survey: SurveyStatistics, white_ratio: float, bias_ratio: float) -> Evidence:
    """The survey's evidence about the weights in units of the signal variance, its offset integrated out."""
    shrink = bias_ratio / (white_ratio + bias_ratio * survey.ones)
    gram = survey.gram - shrink * np.outer(survey.offset, survey.offset)
    target = survey.target - shrink * np.outer(survey.offset, survey.ones_target)
    return Evidence(gram / white_ratio, target / white_ratio)
