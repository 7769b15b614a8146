"""A window as the search sees it: few samples, a lattice of headings, and each sample turned by each heading.

The poses are `(heading, cell of the last sample)`. Displacements are rounded to whole cells per heading, so that a
block of poses displaced by a sample is a block of cells.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.field.expected_error import DECORRELATED_SHARE, UNKNOWN_CORRELATION_M
from app.field.samples import Components
from app.geometry import Array
from app.positioning.features import window_features
from app.positioning.window import Window

__all__ = ["ReducedWindow", "Turned", "effective_samples", "heading_lattice", "reduce_window", "turn_window"]

MIN_HEADINGS, MAX_HEADINGS = 72, 720
MOST_SAMPLES = 200  # of a reduced window: fifty metres at 0.25 m
LEAST_HEADING_SD_RAD = 1e-4
_HEADING_PRIOR_SDS = 4.5  # how far a heading prior is searched


@dataclass(frozen=True, slots=True, eq=False)
class ReducedWindow:
    """The samples that are matched, in order of time.

    features_uT            (n, c) mean of the samples walked over within one spacing, in the window's frame
    from_last_m            (n, 2) their position from the last sample, in the window's frame
    noise_variance_uT2     (n,) of the mean of those samples
    path_m                 (n,) distance walked
    components             what the features are
    turns                  whether a heading turns the features (vector components of a level window)
    """

    features_uT: Array
    from_last_m: Array
    noise_variance_uT2: Array
    path_m: Array
    components: Components
    turns: bool

    def __len__(self) -> int:
        return len(self.features_uT)


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """A window at every heading: features_uT (h, n, c), offset_cells (h, n, 2) (row, column) from the last sample."""

    features_uT: Array
    offset_cells: NDArray[np.int64]


def reduce_window(window: Window, components: Components, spacing_m: float) -> ReducedWindow:
    """Average the samples within each `spacing_m` walked: standing still adds no position information.

    Of more than `MOST_SAMPLES` averages, that many are kept, evenly spaced, the first and the last among them.
    """
    displacement = np.asarray(window.displacement_m, dtype=np.float64)[:, :2]
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(displacement, axis=0), axis=1))])
    bins = np.floor(path / spacing_m + 1e-9).astype(np.int64)
    _, group, count = np.unique(bins, return_inverse=True, return_counts=True)
    kept = np.unique(np.linspace(0, len(count) - 1, min(len(count), MOST_SAMPLES)).round().astype(np.int64))
    return ReducedWindow(
        features_uT=_group_means(window_features(window, components), group, count)[kept],
        from_last_m=_group_means(displacement - displacement[-1], group, count)[kept],
        noise_variance_uT2=window.noise_uT**2 / count[kept],
        path_m=_group_means(path[:, None], group, count)[kept, 0],
        components=components,
        turns=components == "vector" and window.frame == "level",
    )


def heading_lattice(window: Window, step_rad: float) -> Array:
    """Yaws of the window's frame to search, (h,), at most `step_rad` apart; a building window has the one yaw zero.

    A heading with an sd is searched within 4.5 sd, one without (or with an sd of zero) is believed.
    Raises InvalidInput for an sd below 1e-4.
    """
    if window.heading_sd_rad and window.heading_sd_rad < LEAST_HEADING_SD_RAD:
        raise InvalidInput(
            f"heading_sd_rad is {window.heading_sd_rad:g}: no heading is known that well; give at least "
            f"{LEAST_HEADING_SD_RAD:g}, or leave it out to have the heading believed",
            Fault("/window/heading_sd_rad", f"must be at least {LEAST_HEADING_SD_RAD:g}"),
        )
    if window.frame == "building":
        return np.zeros(1)
    reach = np.pi
    centre = window.heading_rad
    if centre is not None:
        reach = min(np.pi, _HEADING_PRIOR_SDS * (window.heading_sd_rad or 0.0))
    if reach >= np.pi:
        count = int(np.ceil(2 * np.pi / step_rad - 1e-9))
        return np.asarray((centre or 0.0) + 2 * np.pi / count * np.arange(count))
    sides = int(np.ceil(reach / step_rad))
    return np.asarray((centre or 0.0) + np.linspace(-reach, reach, 2 * sides + 1))


def turn_window(window: ReducedWindow, headings_rad: Array, resolution_m: float) -> Turned:
    """Turn features and displacements to the building frame at every heading and round to cells."""
    c, s = np.cos(headings_rad)[:, None], np.sin(headings_rad)[:, None]
    dx, dy = window.from_last_m.T
    east, north = c * dx - s * dy, s * dx + c * dy
    offsets = np.rint(np.stack([north, east], axis=-1) / resolution_m).astype(np.int64)
    features = np.broadcast_to(window.features_uT, (len(headings_rad), *window.features_uT.shape)).copy()
    if window.turns:
        x, y = window.features_uT[:, 0], window.features_uT[:, 1]
        features[..., 0], features[..., 1] = c * x - s * y, s * x + c * y
    return Turned(features, offsets)


def effective_samples(path_m: Array, correlation_m: float, share: float = DECORRELATED_SHARE) -> float:
    """How many independent samples a window is worth, at least 1 and at most as many as it has.

    One per `share` of the correlation length walked. A position follows from differences of the field along the walk,
    whose errors decorrelate several times faster than the errors themselves: the default is what calibrates
    (benchmarks/calibration.py). A correlation of zero means unknown, and is taken as two metres.
    """
    n = float(len(path_m))
    if correlation_m <= 0.0:
        correlation_m = UNKNOWN_CORRELATION_M
    return min(n, 1.0 + float(path_m[-1] - path_m[0]) / (share * correlation_m))


def _group_means(values: Array, group: NDArray[np.int64], count: NDArray[np.int64]) -> Array:
    sums = np.zeros((len(count), values.shape[1]))
    np.add.at(sums, group, values)
    return sums / count[:, None]
