"""Corrections from the magnitude alone: Cuenca's GMA and NEDP, and what to use instead (Cuenca 1.8-1.12).

GMA matches a history: of 11 x 11 paths parallel to the one believed, that of the least mean absolute deviation. NEDP
moves its place to the nearest cell that agrees with the last reading. Together they are the source's "GAN", geomagnetic
aided navigation. Both are drawn to the window's centre, which is the filter's own belief; as a measurement they feed a
filter its own error. `window_fix` is a posterior over a window sized by the prior, refused where drawn to its border.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from app.geometry import Array
from app.positioning.contour import contour_tolerance_uT, nearest_on_contour
from app.positioning.mad import least_deviation, mean_absolute_deviation
from app.tracking.map_cells import MapCells
from app.tracking.position_fix import FixSettings, PositionFix, matched_fix

__all__ = [
    "WINDOW_SETTINGS", "ContourFix", "GmaHistory", "gan_fix", "gma_fix", "least_difference", "nedp_fix",
    "square_offsets_m", "window_fix",
]  # fmt: skip

WINDOW_SETTINGS = FixSettings(
    reach_sigmas=5.0,
    least_reach_m=0.0,
    most_reach_m=8.0,
    resolve_prior=True,
    innovation_gate=True,
    most_border_mass=0.05,
)
"""The source's three sigmas cut off 3 % of the variance with every reading, many times a second; five do not. What
three are for, to refuse what is drawn too far, the gate does.
"""


class ContourFix(NamedTuple):
    """position_m (2,); `on_contour` says whether a cell agreed with the reading, else it is GMA's place.

    `confidence` is the second-best offset's deviation over the best one's: near 1 two places fit alike.
    """

    position_m: Array
    on_contour: bool
    confidence: float


def square_offsets_m(side: int = 11, spacing_m: float = 0.1) -> Array:
    """(side^2, 2) offsets of a square window, row by row; the source's is 1 m wide (Cuenca, L613)."""
    steps = spacing_m * (np.arange(side) - (side - 1) / 2.0)
    return np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class GmaHistory:
    """Residuals (k, n) uT of k parallel paths at the last n readings; `length` of them are kept (Cuenca, L629).

    The source gives no length: long ones over-commit, short ones jump (Cuenca, L631).
    """

    offset_m: Array
    length: int = 100
    residual_uT: Array = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def full(self) -> bool:
        return bool(self.residual_uT.shape[1] >= self.length)

    def forgotten(self) -> "GmaHistory":
        """Without its residuals: what they were offset from has moved."""
        return GmaHistory(self.offset_m, self.length)

    def push(self, cells: MapCells, centre_m: Array, norm_uT: float) -> "GmaHistory":
        """With one more reading, taken where the filter believes to be: `cells` hold the magnitude."""
        residual = cells.at(centre_m + self.offset_m) - norm_uT
        earlier = self.residual_uT if self.residual_uT.size else residual[:, :0]
        return replace(self, residual_uT=np.concatenate([earlier, residual], axis=1)[:, -self.length :])


def gma_fix(history: GmaHistory, centre_m: Array, apart_m: float = 0.15) -> ContourFix | None:
    """The centre moved by the offset whose path fits best (Cuenca, L629, eq. 3.5); None where no path is on the map."""
    if not history.residual_uT.size:
        return None
    mad = mean_absolute_deviation(history.residual_uT[..., None])
    choice = least_deviation(mad, history.offset_m, apart_m)
    return None if choice is None else ContourFix(centre_m + history.offset_m[choice.candidate], False, choice.ratio)


def least_difference(cells: MapCells, centre_m: Array, norm_uT: float, offset_m: Array) -> Array | None:
    """(2,) the place of a window whose value differs least from one reading: the rejected baseline (Cuenca, L623)."""
    residual = np.abs(cells.at(centre_m + offset_m)[:, 0] - norm_uT)
    return None if np.isnan(residual).all() else np.asarray(centre_m + offset_m[np.nanargmin(residual)])


def nedp_fix(
    cells: MapCells, from_m: Array, norm_uT: float, reach_m: float, sigma_uT: float, tolerance_uT: float | None = None
) -> Array | None:
    """(2,) the nearest cell to a place that agrees with the reading, at most `reach_m` away (Cuenca, L660, eq. 3.6).

    Without a tolerance it is half the change across a cell, at least one sensor sigma. None where no cell agrees.
    """
    window = cells.window(from_m, np.full(2, reach_m + 2.0 * cells.resolution_m))
    if window is None:
        return None
    values = np.where(window.known, window.mean_uT[..., 0], np.nan)
    tolerance = contour_tolerance_uT(values, window.resolution_m, sigma_uT) if tolerance_uT is None else tolerance_uT
    start = (from_m - np.asarray(window.origin_m)) / window.resolution_m
    point = nearest_on_contour(values, (start[1], start[0]), norm_uT, tolerance, reach_m / window.resolution_m)
    if point is None:
        return None
    return np.asarray(window.origin_m) + window.resolution_m * np.array([point.column, point.row])


def gan_fix(
    history: GmaHistory,
    cells: MapCells,
    centre_m: Array,
    norm_uT: float,
    sigma_uT: float,
    *,
    reach_m: float = 0.5,
    tolerance_uT: float | None = None,
) -> ContourFix | None:
    """GMA, then NEDP from its place (Cuenca, L763); GMA's place where nothing agrees. None off the map.

    `history` has this reading pushed already.
    """
    matched = gma_fix(history, centre_m)
    if matched is None:
        return None
    nearest = nedp_fix(cells, matched.position_m, norm_uT, reach_m, sigma_uT, tolerance_uT)
    return matched if nearest is None else ContourFix(nearest, True, matched.confidence)


def window_fix(
    cells: MapCells,
    reading_uT: Array,
    mean_m: Array,
    covariance_m2: Array,
    noise_sd_uT: float,
    settings: FixSettings = WINDOW_SETTINGS,
) -> PositionFix | None:
    """Moments of prior times likelihood over a window sized by the prior (Cuenca, L611, eq. 3.3; L915).

    The prior is in it: condition a belief on it (`kalman.condition_on_position`), do not fuse it again. `refused` says
    "innovation" or "border" where the reading draws the posterior farther than the prior allows.
    """
    return matched_fix(cells, reading_uT, mean_m, covariance_m2, replace(settings, noise_sd_uT=noise_sd_uT))
