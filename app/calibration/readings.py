"""What a record of a magnetometer must be before anything is fitted to it."""

import numpy as np
from numpy.typing import NDArray

from app.calibration.coverage import refusal
from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["check_readings", "near_the_others"]

GROSS = 4.0
"""Readings this many median distances from the middle of all are spikes."""

MOST_STRENGTHS = 1e5
"""Of the field, in a reading: beyond, it is no field, and its square has no digits left for one."""

SATURATED_SHARE = 0.03
SATURATED_SPREAD = 0.25
"""An axis stands at its largest or smallest value in this share of the readings, while the others move by this part of
their spread: it is clipped. At the top of a circle, rounding keeps an axis still too, but then the others hardly move.
"""


def check_readings(B_uT: Array, reference_uT: float, least: int, axes: int = 3) -> Array:
    """Readings (n, 3) as float64; InvalidInput where they are too few, not finite, constant or clipped.

    `axes`: the first so many are to be fitted, and looked at.
    """
    B = np.asarray(B_uT, dtype=np.float64)
    if B.ndim != 2 or B.shape[1] != 3:
        message = f"Readings must be of shape (n, 3), not {B.shape}."
        raise InvalidInput(message, Fault("B_uT", "not (n, 3)"))
    if not (np.isfinite(reference_uT) and reference_uT > 0):
        message = f"The reference field must be a positive number of microtesla, not {reference_uT}."
        raise InvalidInput(message, Fault("reference_uT", "not positive"))
    bad = ~np.isfinite(B).all(axis=1)
    if bad.any():
        message = f"{bad.sum()} readings are not finite, the first at {int(np.argmax(bad))}. Drop them."
        raise InvalidInput(message, Fault(f"B_uT/{int(np.argmax(bad))}", "not finite"))
    if len(B) < least:
        raise refusal(f"{len(B)} readings are too few: {least} are the least", ["record for longer while turning"])
    if np.abs(B).max() > MOST_STRENGTHS * reference_uT:
        message = f"Readings go up to {np.abs(B).max():.3g} uT, in a field of {reference_uT:g} uT. Send microtesla."
        raise InvalidInput(message, Fault("B_uT", "no magnetic field"))
    spread = B[:, :axes].std(axis=0)
    if np.all(spread < 1e-3 * reference_uT):
        raise refusal("The readings are constant", ["turn the device while recording"])
    _refuse_saturated(B[:, :axes], spread)
    return B


def near_the_others(B_uT: Array) -> NDArray[np.bool_]:
    """(n,) false at gross spikes, which would spoil even the start of a fit. For (n, d). Raises InvalidInput."""
    distance = np.linalg.norm(B_uT - np.median(B_uT, axis=0), axis=1)
    usual = float(np.median(distance))
    if usual == 0.0:
        raise refusal("Half of the readings are one and the same", ["leave out what was recorded at rest"])
    return np.asarray(distance <= GROSS * usual)


def _refuse_saturated(B: Array, spread: Array) -> None:
    for k in range(B.shape[1]):
        for extreme, side in ((B[:, k].max(), "largest"), (B[:, k].min(), "smallest")):
            there = B[:, k] == extreme
            others = np.arange(B.shape[1]) != k
            if spread[k] < 1e-3 * spread.max() or there.sum() < max(3.0, SATURATED_SHARE * len(B)):
                continue
            moved = B[there][:, others].std(axis=0)
            if np.any(moved > SATURATED_SPREAD * np.maximum(spread[others], 1e-12)):
                raise refusal(
                    f"Axis {'xyz'[k]} stands at its {side} value, {extreme:g} uT, in {there.sum()} readings: saturated",
                    ["take the device away from magnets, or choose a larger range of the sensor"],
                )
