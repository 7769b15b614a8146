"""The likelihood of a window against worked examples and against numerical integration."""

import numpy as np
import pytest
from scipy.integrate import quad

from app.positioning.likelihood import window_likelihood


@pytest.mark.parametrize(
    ("sd", "shares", "beta"),
    [
        (2.65, [0.867275, 1.50461e-11, 1.4425e-280], 3.41187e-3),
        (7.21, [0.980947, 3.45132e-2, 1.5721e-38], 1.69404e-4),
    ],
)
def test_a_vector_at_three_map_rows(sd: float, shares: list, beta: float) -> None:
    z = np.array([201.0, -20.0, 493.0])
    rows = np.array([[200.0, -21, 493], [210, -30, 480], [150, 60, 500]])
    found = window_likelihood((z - rows)[:, None, :], np.full((1, 3), sd**2), False)
    np.testing.assert_allclose(found.distance2 * sd**2, [2.0, 350.0, 9050.0])
    np.testing.assert_allclose(np.exp(found.log_l) / beta, shares, rtol=1e-4)


@pytest.mark.parametrize(("demeaned", "squares"), [(False, 975.0), (True, 5.75)])
def test_demeaning_removes_a_constant_offset(demeaned: bool, squares: float) -> None:
    section = np.array([[200.0, -20, 490], [205, -18, 492], [212, -15, 497], [206, -19, 493]])
    error = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 2], [-1, 0, 0]])
    map_section = section + np.array([12.0, -8, 5]) + error
    found = window_likelihood(section - map_section, np.full((4, 3), 4.0), demeaned)
    assert 4.0 * found.distance2 == pytest.approx(squares)


def test_demeaned_is_the_integral_over_the_offset() -> None:
    rng = np.random.default_rng(0)
    residual, variance = rng.normal(3.0, 1.0, (5, 1)), rng.uniform(0.5, 4.0, (5, 1))
    integral, _ = quad(
        lambda b: float(np.exp(window_likelihood(residual - b, variance, False).log_l)), -20.0, 20.0, points=[3.0]
    )
    assert window_likelihood(residual, variance, True).log_l == pytest.approx(np.log(integral), abs=1e-6)
