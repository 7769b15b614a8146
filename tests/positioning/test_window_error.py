"""The errors of a window: worked examples, a dense second implementation, and numerical integration over the offset."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.stats import multivariate_normal

from app.field.error_structure import ErrorStructure
from app.positioning.window_error import differenced, plain_error, weigh_residuals, window_error


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
    found = weigh_residuals((z - rows)[:, None, :], np.full((3, 1), sd**2), plain_error(1))
    np.testing.assert_allclose(found.distance2 * sd**2, [2.0, 350.0, 9050.0])
    np.testing.assert_allclose(np.exp(found.log_l) / beta, shares, rtol=1e-4)


@pytest.mark.parametrize(("composition", "squares"), [("raw", 975.0), ("demeaned", 5.75), ("differenced", 12.0)])
def test_sums_of_squares_of_the_compositions(composition: str, squares: float) -> None:
    """The worked example of Shockley 8.6."""
    section = np.array([[200.0, -20, 490], [205, -18, 492], [212, -15, 497], [206, -19, 493]])
    error = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 2], [-1, 0, 0]])
    map_section = section + np.array([12.0, -8, 5]) + error
    model = plain_error(4, 0.0 if composition == "demeaned" else None)
    if composition == "differenced":
        model = dataclasses.replace(model, whiten=differenced(4))
    found = weigh_residuals(section - map_section, np.full(4, 4.0), model)
    assert 4.0 * found.distance2 == pytest.approx(squares)


def test_a_flat_offset_is_integrated_out() -> None:
    rng = np.random.default_rng(0)
    residual, variance = rng.normal(3.0, 1.0, (5, 1)), rng.uniform(0.5, 4.0, 5)
    integral, _ = quad(
        lambda b: float(np.exp(weigh_residuals(residual - b, variance, plain_error(5)).log_l)),
        -20.0,
        20.0,
        points=[3.0],
    )
    assert weigh_residuals(residual, variance, plain_error(5, 0.0)).log_l == pytest.approx(np.log(integral), abs=1e-6)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(1, 12),
    constant=st.floats(0.0, 0.4),
    walk=st.floats(0.0, 0.5),
    length_m=st.floats(0.3, 6.0),
    bias_sd_uT=st.floats(0.0, 8.0),
)
def test_is_the_density_of_the_covariance_it_states(
    seed: int, n: int, constant: float, walk: float, length_m: float, bias_sd_uT: float
) -> None:
    rng = np.random.default_rng(seed)
    path, noise = np.cumsum(rng.uniform(0.0, 0.7, n)), rng.uniform(0.0, 0.5, n)
    typical = 2.0
    error = window_error(path, noise, typical, ErrorStructure(constant, walk, 0.4, length_m), bias_sd_uT)
    residual, variance = rng.normal(0.0, 2.0, (n, 2)), rng.uniform(0.5, 3.0, n)
    share = walk * typical / ((walk + 0.4) * typical + noise.mean())
    R = share * np.exp(-np.abs(path[:, None] - path[None, :]) / length_m)
    np.fill_diagonal(R, 1.0)
    C = np.sqrt(variance)[:, None] * R * np.sqrt(variance) + bias_sd_uT**2 + constant * typical
    expected = sum(multivariate_normal(np.zeros(n), C).logpdf(residual[:, k]) for k in range(2))
    found = weigh_residuals(residual, variance, error)
    assert found.log_l == pytest.approx(expected, abs=1e-6)
    assert found.distance2 == pytest.approx(float(np.sum(residual * np.linalg.solve(C, residual))), rel=1e-6, abs=1e-9)
    searched = error.inflation * np.diag(variance) + bias_sd_uT**2 + constant * typical
    assert np.linalg.eigvalsh(searched - C)[0] > -1e-9, "what is searched by dominates what is believed"
