"""What of a window does not fit where it fits best: a component, a stretch of the walk, or the sensor's offset."""

import numpy as np

from app.geometry import Array
from app.positioning.belief import Belief
from app.positioning.matching import Matched
from app.positioning.refine import Refined
from app.positioning.scoring import sensor_residual

__all__ = ["misfit", "residual_rms_uT", "standardised_residuals"]

_NAMES = {"vector": ("x", "y", "vertical"), "level": ("horizontal", "vertical"), "norm": ("magnitude",)}
_OFFSET_SDS = 3.0
_MOST_OF_IT = 0.6


def standardised_residuals(matched: Matched, fine: Refined) -> Array:
    """(n, c) residuals of a refined pose, seen from the sensor and less its offset, in sds of one reading."""
    window = matched.window
    sensor_yaw = window.yaw_rad + (fine.pose[0, 2] if window.turns else 0.0)
    turn = np.column_stack([np.cos(sensor_yaw), np.sin(sensor_yaw)])
    seen = sensor_residual(fine.residual_uT[0], turn, window.tilt) - fine.bias_uT[0]
    sd = np.sqrt(matched.error.own_share * fine.variance_uT2[0] + window.noise_variance_uT2)
    return np.asarray(seen / sd[:, None])


def residual_rms_uT(matched: Matched, fine: Refined) -> float:
    """Root mean square (uT) over samples and components of a refined pose's residuals, less the sensor's offset."""
    sd = np.sqrt(matched.error.own_share * fine.variance_uT2[0] + matched.window.noise_variance_uT2)
    seen = standardised_residuals(matched, fine) * sd[:, None] / matched.window.scale
    return float(np.sqrt(np.mean(np.square(seen))))


def misfit(matched: Matched, belief: Belief) -> str:
    """In words: where most of the misfit of the best match lies."""
    fine = belief.best.refined
    squares = np.square(standardised_residuals(matched, fine))
    said = []
    precision = matched.error.offset_precision
    if precision:
        offset = fine.bias_uT[0] / matched.window.scale
        if np.linalg.norm(fine.bias_uT[0]) > _OFFSET_SDS * precision**-0.5 * len(offset) ** 0.5:
            said.append(f"the sensor seems off by {np.array2string(offset, precision=1)} uT in its own axes")
    share = squares.sum(axis=0) / squares.sum()
    if len(share) > 1 and share.max() > _MOST_OF_IT:
        name = _NAMES[matched.window.components][int(share.argmax())]
        said.append(f"{100 * share.max():.0f} % of the misfit is in the {name} component")
    stretch = _worst_stretch(squares.sum(axis=1))
    if stretch is not None:
        path = matched.window.path_m
        said.append(
            f"most of the misfit lies between {path[stretch[0]]:.1f} and {path[stretch[1]]:.1f} m along the walk"
        )
    return "; ".join(said)


def _worst_stretch(squares: Array) -> tuple[int, int] | None:
    """First and last sample of the shortest run that holds most of the misfit, if it is less than half of the walk."""
    n, total = len(squares), float(squares.sum())
    held = np.concatenate([[0.0], np.cumsum(squares)])
    for length in range(1, n // 2):
        sums = held[length:] - held[:-length]
        start = int(np.argmax(sums))
        if sums[start] > _MOST_OF_IT * total:
            return start, start + length - 1
    return None
