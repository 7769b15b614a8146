"""Why a filter was wrong, told from how the reading fits where it was and where it should have been (Kuevor B29)."""

from typing import Literal

import numpy as np

from app.geometry import Array

__all__ = ["Attribution", "attribute_error", "windowed_misfit_uT"]

Attribution = Literal["accurate", "inconsistent", "alternate path", "low gradient", "unexplained"]


def attribute_error(
    error_m: Array,
    misfit_at_estimate_uT: float,
    misfit_at_truth_uT: float,
    slope_uT_per_m: Array,
    coverage_2sigma: float,
    *,
    accurate_m: float = 0.2,
    comparable: float = 0.25,
    weak_uT_per_m: float = 3.0,
    least_coverage: float = 0.8,
) -> Attribution:
    """The source's diagnosis of a position error (3,) against the truth, over a stretch of a log (Kuevor, L1837-L1934).

    misfits: norms of map less reading at the estimate and at the truth (`windowed_misfit_uT`); slope (3,): norms of
    the Jacobian's columns at the truth; coverage: share of readings within two sd of the map at the truth.

    inconsistent    coverage is lost: map and log do not agree, whatever the filter does (L1781, L2124)
    alternate path  a wrong place fits better than the right one (L1860-L1866)
    low gradient    both fit alike, and the column of the axis that errs most is weak (L1934)

    The thresholds are ours; the source judges by eye.
    """
    if np.linalg.norm(error_m) <= accurate_m:
        return "accurate"
    if coverage_2sigma < least_coverage:
        return "inconsistent"
    if misfit_at_estimate_uT < (1.0 - comparable) * misfit_at_truth_uT:
        return "alternate path"
    alike = misfit_at_estimate_uT <= (1.0 + comparable) * misfit_at_truth_uT
    if alike and slope_uT_per_m[int(np.argmax(np.abs(error_m)))] < weak_uT_per_m:
        return "low gradient"
    return "unexplained"


def windowed_misfit_uT(mean_uT: Array, reading_uT: Array) -> float:
    """Root mean square over a stretch of the norms of map (n, c) less reading (n, c) (Kuevor, eq. 4.12)."""
    return float(np.sqrt(np.mean(np.sum(np.square(mean_uT - reading_uT), axis=1))))
