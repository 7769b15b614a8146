"""Is the field in microtesla? Judged by the length of the field against the Earth's 20-70 uT."""

from collections.abc import Callable

import numpy as np

from app.errors import Fault
from app.geometry import UT_PER_GAUSS, UT_PER_MILLIGAUSS, UT_PER_NANOTESLA, Array

__all__ = ["MAX_FIELD_UT", "MIN_FIELD_UT", "field_faults", "guess_unit"]

MIN_FIELD_UT, MAX_FIELD_UT = 1.0, 2000.0
"""Readings outside this range are refused."""
PLAUSIBLE_MEDIAN_UT = (5.0, 150.0)
"""The median of |B| over a walk lies here in any building; the Earth's field is 20-70 uT, steel bends it."""

_UNITS = (
    ("nanotesla", UT_PER_NANOTESLA, "divide by 1,000"),
    ("milligauss", UT_PER_MILLIGAUSS, "divide by 10"),
    ("gauss", UT_PER_GAUSS, "multiply by 100"),
    ("millitesla", 1e3, "multiply by 1,000"),
    ("tesla", 1e6, "multiply by 1,000,000"),
)


def guess_unit(typical: float) -> str | None:
    """What a typical |B| looks like if it is not microtesla, with what to do: "nanotesla: divide by 1,000"."""
    low, high = PLAUSIBLE_MEDIAN_UT
    if low <= typical < high:
        return None
    fits = [(abs(np.log(typical * factor / 45.0)), f"{name}: {advice}") for name, factor, advice in _UNITS
            if typical > 0 and low <= typical * factor < high]  # fmt: skip
    return min(fits)[1] if fits else None


def field_faults(norm_uT: Array, location: Callable[[int], str]) -> tuple[str | None, list[Fault]]:
    """What is wrong with the lengths (n,) of the field, as a sentence and faults; (None, []) when nothing is.

    A median outside what buildings have is a wrong unit (or a bias left in), and the whole file is refused; single
    readings outside 1-2,000 uT are listed one by one.
    """
    typical = float(np.median(np.abs(norm_uT)))
    outside = np.flatnonzero((norm_uT < MIN_FIELD_UT) | (norm_uT > MAX_FIELD_UT))
    guess = guess_unit(typical)
    if guess:
        worst = int(outside[0]) if len(outside) else int(np.argmax(norm_uT))
        message = f"the field is not in microtesla: a median |B| of {_figure(typical)} looks like {guess}"
        if typical >= PLAUSIBLE_MEDIAN_UT[1] and typical <= MAX_FIELD_UT:
            message += "; if it is microtesla, the sensor's hard iron was not removed: subtract its bias"
        reading = float(norm_uT[worst])
        return message, [
            Fault(location(worst), f"a reading of {_figure(reading)} looks like {guess_unit(reading) or guess}")
        ]
    if not len(outside):
        return None, []
    faults = [Fault(location(int(i)), _single(float(norm_uT[i]))) for i in outside[:20]]
    return (
        f"{len(outside)} of {len(norm_uT)} readings of the field are outside {MIN_FIELD_UT:.0f}-{MAX_FIELD_UT:,.0f} uT "
        f"({faults[0].location}); the field has to be in microtesla, and saturated readings removed",
        faults,
    )


def _single(reading: float) -> str:
    """Why one reading among good ones is refused."""
    reason = f"|B| of {_figure(reading)} uT is outside {MIN_FIELD_UT:.0f}-{MAX_FIELD_UT:,.0f} uT"
    guess = guess_unit(reading) if reading > MAX_FIELD_UT else None
    return f"{reason}; it looks like {guess}" if guess else reason


def _figure(x: float) -> str:
    return f"{x:,.0f}" if x >= 1000.0 else f"{x:.4g}"
