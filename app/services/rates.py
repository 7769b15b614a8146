"""Shares of windows with standard errors that respect that the windows of one walk are alike."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Rate", "rate"]


@dataclass(frozen=True, slots=True)
class Rate:
    """A share of windows with its standard error; share None when there is no window to take it of."""

    share: float | None
    standard_error: float | None
    windows: int

    def __str__(self) -> str:
        if self.share is None:
            return "-"
        error = "" if self.standard_error is None else f" ±{self.standard_error:.2f}".replace("0.", ".")
        return f"{self.share:.2f}".replace("0.", ".", 1 if self.share < 1 else 0) + error


def rate(values: Sequence[bool] | Sequence[float], walks: Sequence[str]) -> Rate:
    """Share of true values, or the mean of others; the standard error counts walks, not windows, as independent.

    Linearised, n / (n - 1).
    """
    if not len(values):
        return Rate(None, None, 0)
    share = float(np.mean(values))
    _, group = np.unique(np.asarray(walks), return_inverse=True)
    sums = np.bincount(group, weights=np.asarray(values, dtype=np.float64) - share)
    count = len(sums)
    if count < 2:
        return Rate(share, None, len(values))
    variance = count / (count - 1) * float(np.sum(np.square(sums))) / len(values) ** 2
    return Rate(share, float(np.sqrt(variance)), len(values))
