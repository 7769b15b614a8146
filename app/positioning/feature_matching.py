"""Match a magnetic feature alone: a section about an anomaly, its peak laid on the peaks of the map (Shockley 8.7).

A feature is a stretch that stands out of its surroundings. The seed found features by eye; here the peak of a window is
the sample farthest from the window's median, and its section reaches to where the deviation has halved. Peaks of the
map are the local maxima of the field's deviation from its mean over ten metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, uniform_filter

from app.errors import Fault, InvalidWindow
from app.positioning.floors import Plane
from app.positioning.lattice import Courses, ReducedWindow, turn_window
from app.positioning.search import Candidates

__all__ = ["Feature", "feature_candidates", "find_feature", "map_peaks", "with_aligned"]

SURROUNDINGS_M = 10.0
PEAK_REACH_M = 1.0
LEAST_SAMPLES = 3
_LEAST_SDS = 4.0  # of one reading, for a deviation to be a feature
_LIKE_SHARE = 0.5  # of the window's peak: lower peaks of the map are other features
_MOST_POSES = 400_000
_NEAR = np.array([(j, i) for j in (-1, 0, 1) for i in (-1, 0, 1)])


@dataclass(frozen=True, slots=True, eq=False)
class Feature:
    """section: the window cut to its feature (positions still from the window's last sample); peak: index in it;
    deviation_uT: of the peak from the window's median."""

    section: ReducedWindow
    peak: int
    deviation_uT: float


def find_feature(window: ReducedWindow, sd_uT: float) -> Feature:
    """The strongest feature of a window, given the sd of one reading about the map.

    Raises InvalidWindow when nothing stands out.
    """
    deviation = np.linalg.norm(window.features_uT - np.median(window.features_uT, axis=0), axis=1)
    peak = int(np.argmax(deviation))
    least = _LEAST_SDS * sd_uT
    if len(window) < LEAST_SAMPLES or deviation[peak] < least:
        reason = (
            f"nothing in this window stands out: its largest deviation from its median is {deviation[peak]:.1f} uT, a "
            f"feature here needs {least:.1f}; use composition raw, or walk past steel"
        )
        raise InvalidWindow(reason, Fault("/composition", reason))
    low = np.flatnonzero(deviation < 0.5 * deviation[peak])
    first = int(max(low[low < peak], default=-1)) + 1
    last = int(min(low[low > peak], default=len(window))) - 1
    first, last = max(first - 1, 0), min(last + 1, len(window) - 1)
    part = slice(first, last + 1)
    section = replace(
        window,
        features_uT=window.features_uT[part],
        from_last_m=window.from_last_m[part],
        noise_variance_uT2=window.noise_variance_uT2[part],
        path_m=window.path_m[part],
        yaw_rad=window.yaw_rad[part],
        tilt=window.tilt[part] if len(window.tilt) else window.tilt,
    )
    return Feature(section, peak - first, float(deviation[peak]))


def map_peaks(plane: Plane, least_uT: float) -> NDArray[np.int64]:
    """(k, 2) cells (row, column) where the field stands out most of its surroundings, by `least_uT`, highest first."""
    mean = plane.mean_uT[1:-1, 1:-1].astype(np.float64)
    known = plane.measured.astype(np.float64)
    side = max(3, round(SURROUNDINGS_M / plane.resolution_m))
    weight = uniform_filter(known, side, mode="constant")
    around = uniform_filter(mean * known[..., None], (side, side, 0), mode="constant")
    deviation = np.linalg.norm(mean - around / np.maximum(weight, 1e-9)[..., None], axis=-1) * known
    reach = 2 * max(1, round(PEAK_REACH_M / plane.resolution_m)) + 1
    row, column = np.nonzero((deviation >= maximum_filter(deviation, reach)) & (deviation >= least_uT))
    order = np.argsort(-deviation[row, column], kind="stable")
    return np.stack([row, column], axis=1)[order]


def feature_candidates(feature: Feature, planes: Sequence[Plane], courses: Courses) -> Candidates:
    """Every pose that lays the feature's peak on a like peak of the map, or on a cell beside it, in any course.

    Scores are minus infinity: they have to be found yet.
    """
    parts: list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]] = []
    room = _MOST_POSES // (len(planes) * len(courses) * len(_NEAR))
    complete = True
    for k, plane in enumerate(planes):
        peaks = map_peaks(plane, _LIKE_SHARE * feature.deviation_uT)
        complete &= len(peaks) <= max(room, 1)
        cells = (peaks[: max(room, 1), None, :] + _NEAR).reshape(-1, 2)
        offset = turn_window(feature.section, courses, plane.resolution_m).offset_cells[:, feature.peak]
        last = cells[None] - offset[:, None]
        inside = (last >= 0).all(axis=2) & (last < plane.shape).all(axis=2)
        course, cell = np.nonzero(inside)
        parts.append((np.full(len(course), k), course, last[course, cell, 0], last[course, cell, 1]))
    plane_of, course, row, column = (np.concatenate([part[m] for part in parts]) for m in range(4))
    if not len(plane_of):
        reason = "no place of the map stands out like this window's feature; use composition raw"
        raise InvalidWindow(reason, Fault("/composition", reason))
    return Candidates(
        plane_of, course, row, column, np.full(len(course), -np.inf), window_nats=np.inf, complete=complete,
        missed_mass=0.0, poses=len(course),
    )  # fmt: skip


def with_aligned(found: Candidates, aligned: Candidates) -> tuple[Candidates, NDArray[np.bool_]]:
    """Searched and aligned poses together, each once, and which are aligned.

    A belief must hold the places where no peak is known as well: a feature the map does not list fits somewhere, too.
    """
    both = [
        np.concatenate([a, b])
        for a, b in (
            (aligned.plane, found.plane), (aligned.course, found.course), (aligned.row, found.row),
            (aligned.column, found.column), (aligned.score, found.score),
        )
    ]  # fmt: skip
    _, first = np.unique(np.stack(both[:4], axis=1), axis=0, return_index=True)
    plane, course, row, column = (np.asarray(part[first], dtype=np.int64) for part in both[:4])
    together = replace(found, plane=plane, course=course, row=row, column=column, score=both[4][first],
                       complete=found.complete and aligned.complete)  # fmt: skip
    return together, np.asarray(first < len(aligned.plane))
