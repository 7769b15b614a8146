"""How much farther to walk before a window tells the places it may be at apart, from the map's own ambiguity.

Every mode is continued straight ahead of the device. Where the field along two continuations, seen from the device,
differs by d, a reading there is expected to add |d|^2 / (2 v) to the log ratio of the two places if one of them is
right, v the variance of one reading; readings of errors alike along the walk count once per inflation.
"""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array
from app.positioning.belief import Belief, BelievedMode
from app.positioning.features import reduce_field
from app.positioning.matching import Matched

__all__ = ["Further", "walk_further"]

FARTHEST_M = 40.0
_STEP_M = 0.5
_LIKELY_SHARE = 0.02  # of the strongest: weaker modes are no rivals
_WANTED_LOG_RATIO = float(np.log(20.0))


@dataclass(frozen=True, slots=True)
class Further:
    """distance_m   straight ahead until the strongest place is expected to be 20 times likelier than every rival, None
                 if no such distance is short enough
    rivals       how many other places there are
    apart_m      of the nearest rival on the same floor, None if there is none
    """

    distance_m: float | None
    rivals: int
    apart_m: float | None


def walk_further(matched: Matched, belief: Belief) -> Further | None:
    """What walking straight ahead is expected to settle; None where there are no places to tell apart."""
    strongest, *others = belief.modes
    rivals = [mode for mode in others if mode.probability >= _LIKELY_SHARE * strongest.probability]
    if not rivals:
        return None
    ahead = np.arange(_STEP_M, FARTHEST_M + 1e-9, _STEP_M)
    seen, variance = _continued(matched, strongest, ahead)
    enough = np.ones(len(ahead), dtype=np.bool_)
    per_step = matched.error.inflation
    for rival in rivals:
        other, of_other = _continued(matched, rival, ahead)
        told = np.sum(np.square(seen - other), axis=1) / (2.0 * (variance + of_other) * per_step)
        ratio = np.log(max(strongest.probability, 1e-300) / max(rival.probability, 1e-300)) + np.cumsum(told)
        enough &= ratio >= _WANTED_LOG_RATIO
    near = [
        float(np.linalg.norm(rival.pose[:2] - strongest.pose[:2])) for rival in rivals if rival.plane == strongest.plane
    ]
    distance = float(ahead[int(np.argmax(enough))]) if enough.any() else None
    return Further(distance, len(rivals), min(near, default=None))


def _continued(matched: Matched, mode: BelievedMode, ahead_m: Array) -> tuple[Array, Array]:
    """Features (k, c) in the device's frame straight ahead of a mode, and the variances (k,) of readings there."""
    plane = matched.planes[mode.plane]
    floor = matched.floors[matched.plane_floor[mode.plane]]
    course = matched.device_heading_rad(mode.pose)
    if course is None:  # a building window: on along its own course
        moved = matched.window.from_last_m[-1] - matched.window.from_last_m[max(len(matched.window) - 2, 0)]
        course = float(np.arctan2(moved[1], moved[0]))
    c, s = np.cos(course), np.sin(course)
    points = np.column_stack([
        mode.pose[0] + ahead_m * c, mode.pose[1] + ahead_m * s, np.full(len(ahead_m), plane.height_m)
    ])  # fmt: skip
    values = floor.grid.at(points)
    mean = plane.scale * reduce_field(values.mean_uT, floor.grid.components, matched.window.components)
    if matched.window.turns:
        mean = np.column_stack([c * mean[:, 0] + s * mean[:, 1], c * mean[:, 1] - s * mean[:, 0], mean[:, 2]])
    sd = np.where(values.measured[:, None], values.sd_uT, floor.grid.prior_sd_uT)
    return mean, np.mean(np.square(sd), axis=1) + 0.5 * float(np.mean(np.square(floor.noise_sd_uT)))
