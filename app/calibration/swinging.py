"""Swinging: turn level, take the largest and the smallest of each axis (Shockley, L501-L535; Eqs. 2.9-2.13).

Mended (Shockley, 3.3): biases are +(max + min)/2 and subtracted (E3), the swing of an axis is the horizontal field and
not its northern part (E7), the vertical is corrected once (E4). Extremes of noisy readings lie outside the circle; how
far is worked out from the noise, and taken off. What swinging cannot see is distortion: it skews what is left.
"""

from typing import Literal, NamedTuple

import numpy as np
from scipy.special import log_ndtr

from app.calibration.circle import Ellipse, circle_model, fit_ellipse, vertical_offset_uT
from app.calibration.fit import CalibrationFit, conclude_circle
from app.geometry import Array

__all__ = ["caruso", "swinging"]

_GRID = np.linspace(-4.0, 7.0, 441)


class _Swing(NamedTuple):
    """Of one axis: centre and half-range, uT, and their variances."""

    centre_uT: float
    half_uT: float
    centre_uT2: float
    half_uT2: float


def swinging(
    B_uT: Array,
    horizontal_uT: float,
    vertical_uT: float,
    *,
    extremes: Literal["unbiased", "plain"] = "unbiased",
    literal: bool = False,
    north_uT: float | None = None,
) -> CalibrationFit:
    """From readings (n, 3), uT, while the device turned level through whole circles; x and y lie level.

    extremes: "unbiased", or "plain" as in the source: then scales come out low, by 2 % at 1 % noise. `literal` is the
    source as printed, with the northern part `north_uT` of the field as numerator and the vertical corrected twice;
    the clash of signs of Eqs. 2.10 and 2.13 is mended even so, since it yields nothing. Raises InvalidInput.
    """
    ellipse = fit_ellipse(B_uT, horizontal_uT)
    plain = literal or extremes == "plain"
    x, y = (_swing(ellipse, k, horizontal_uT, plain) for k in (0, 1))
    numerator = (horizontal_uT if north_uT is None else abs(north_uT)) if literal else horizontal_uT
    scale = np.array([numerator / x.half_uT, numerator / y.half_uT])
    offset_uT, offset_sd_uT = vertical_offset_uT(ellipse, vertical_uT)
    scale_z = 1.0
    if literal:
        z = ellipse.B_uT[:, 2]
        offset_uT = float(z.max() + z.min()) / 2.0 - vertical_uT
        scale_z = abs(vertical_uT) / float(np.mean(np.abs(z)))
    model = circle_model(np.diag(scale), np.array([x.centre_uT, y.centre_uT]), offset_uT, scale_z)
    parameters = {
        "hard_iron_x_ut": x.centre_uT, "hard_iron_y_ut": y.centre_uT, "correction_xx": float(scale[0]),
        "correction_yy": float(scale[1]),
    }  # fmt: skip
    scale_variance = scale**2 * [x.half_uT2 / x.half_uT**2, y.half_uT2 / y.half_uT**2]
    covariance = np.diag([x.centre_uT2, y.centre_uT2, *scale_variance])
    return conclude_circle(
        "swinging", parameters, covariance, model, ellipse.B_uT, ellipse.outlier, ellipse.condition, horizontal_uT,
        offset_sd_uT, must_fit=not literal,
    )  # fmt: skip


def caruso(B_uT: Array) -> tuple[Array, Array]:
    """(scale (2,), hard iron (2,) uT, to subtract) with no knowledge of the field (Shockley, Eqs. 2.9, 2.10).

    Only the ratio of the axes is put right: one scale is 1. Good for headings (`-atan2(y, x)` where z points down).
    """
    top, bottom = B_uT[:, :2].max(axis=0), B_uT[:, :2].min(axis=0)
    span = top - bottom
    return np.maximum(1.0, span[::-1] / span), (top + bottom) / 2.0


def _swing(ellipse: Ellipse, axis: int, horizontal_uT: float, plain: bool) -> _Swing:
    """Largest and smallest of an axis, less what noise adds to them if not `plain`, with their variances."""
    kept = ellipse.B_uT[~ellipse.outlier, :2]
    reading = kept[:, axis]
    corrected = (kept - ellipse.hard_iron_uT) @ ellipse.correction.T
    unit = corrected / np.linalg.norm(corrected, axis=1, keepdims=True)
    clean = horizontal_uT * unit @ np.linalg.inv(ellipse.correction).T[:, axis] + ellipse.hard_iron_uT[axis]
    reach = horizontal_uT * float(np.linalg.norm(np.linalg.inv(ellipse.correction)[axis]))
    middle = float(ellipse.hard_iron_uT[axis])
    above, above2 = _excess(middle + reach - clean, ellipse.noise_uT)
    below, below2 = _excess(clean - (middle - reach), ellipse.noise_uT)
    if plain:
        above = below = 0.0
    top, bottom = float(reading.max()) - above, float(reading.min()) + below
    variance = 0.25 * (above2 + below2)
    return _Swing(0.5 * (top + bottom), 0.5 * (top - bottom), variance, variance)


def _excess(short_uT: Array, noise_uT: float) -> tuple[float, float]:
    """Mean and variance of how far the largest of `noise - short` (n,) lies above zero; short >= 0, sd of noise given.

    P(largest < t) is the product over all readings.
    """
    if noise_uT < 1e-9 * float(np.max(short_uT)):
        return -float(np.min(short_uT)), noise_uT**2
    near = short_uT[short_uT < 8.0 * noise_uT] / noise_uT
    below = np.exp(log_ndtr(_GRID[:, None] + near).sum(axis=1))
    density, middle = np.diff(below), 0.5 * (_GRID[1:] + _GRID[:-1])
    mean = float(density @ middle)
    return mean * noise_uT, float(density @ (middle - mean) ** 2) * noise_uT**2
