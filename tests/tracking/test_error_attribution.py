"""The source's diagnoses on scripted cases (Kuevor B29)."""

import numpy as np
import pytest

from app.tracking.error_attribution import attribute_error, windowed_misfit_uT

STEEP, WEAK_IN_X = np.array([8.0, 9.0, 7.0]), np.array([1.5, 6.0, 4.0])
IN_X = np.array([0.4, 0.02, 0.1])


@pytest.mark.parametrize(
    ("error_m", "at_estimate", "at_truth", "slope", "coverage", "diagnosis"),
    [
        (np.array([0.05, 0.03, 0.01]), 0.5, 0.4, STEEP, 0.97, "accurate"),
        (IN_X, 0.5, 1.5, STEEP, 0.96, "alternate path"),
        (IN_X, 0.5, 1.5, WEAK_IN_X, 0.96, "alternate path"),
        (IN_X, 0.52, 0.5, WEAK_IN_X, 0.97, "low gradient"),
        (IN_X[[1, 0, 2]], 0.52, 0.5, WEAK_IN_X, 0.97, "unexplained"),
        (IN_X, 2.0, 2.5, WEAK_IN_X, 0.5, "inconsistent"),
        (IN_X, 3.0, 0.5, STEEP, 0.97, "unexplained"),
    ],
    ids=["small", "wrong place fits better", "... also where slopes are weak", "weak axis", "strong axis", "lost", "-"],
)
def test_scripted(error_m, at_estimate, at_truth, slope, coverage, diagnosis):
    assert attribute_error(error_m, at_estimate, at_truth, slope, coverage) == diagnosis


def test_misfit():
    assert windowed_misfit_uT(np.array([[3.0, 4.0], [0.0, 0.0]]), np.zeros((2, 2))) == pytest.approx(np.sqrt(12.5))
