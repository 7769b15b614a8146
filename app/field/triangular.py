"""The inverse of a triangular factor, by halves: LAPACK's own works column by column, at half the speed."""

import numpy as np
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dtrtri

from app.geometry import Array

__all__ = ["inverse_of_lower"]

WHOLE = 64
"""Up to this size LAPACK is as fast."""


def inverse_of_lower(factor: Array) -> Array:
    """(m, m) of the lower triangle of a factor, in Fortran order; above the diagonal nothing is meant."""
    m = len(factor)
    if m <= WHOLE:
        inverse, info = dtrtri(factor, lower=1)
        assert info == 0, info
        return np.asarray(inverse)
    half = m // 2
    first, last = inverse_of_lower(factor[:half, :half]), inverse_of_lower(factor[half:, half:])
    between = dtrmm(1.0, first, factor[half:, :half], side=1, lower=1)
    inverse = np.zeros((m, m), order="F")
    inverse[:half, :half], inverse[half:, half:] = first, last
    inverse[half:, :half] = dtrmm(-1.0, last, between, lower=1, overwrite_b=1)
    return inverse
