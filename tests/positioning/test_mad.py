"""Mean absolute deviation against its definition, and what it does where a map is unknown."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from app.positioning.mad import least_deviation, mean_absolute_deviation

SHAPES = st.tuples(st.integers(1, 6), st.integers(1, 6), st.integers(1, 3))
RESIDUALS = SHAPES.flatmap(lambda s: arrays(float, s, elements=st.one_of(st.floats(-50.0, 50.0), st.just(np.nan))))


def by_hand(residual, least_share):
    out = []
    for candidate in residual:
        known = [abs(value) for value in candidate.ravel().tolist() if value == value]
        enough = known and len(known) >= least_share * candidate.size
        out.append(sum(known) / len(known) if enough else np.nan)
    return out


@given(RESIDUALS, st.floats(0.0, 1.0))
def test_as_by_hand(residual, share):
    np.testing.assert_allclose(mean_absolute_deviation(residual, share), by_hand(residual, share), rtol=1e-12)


@given(RESIDUALS, st.floats(0.1, 10.0))
def test_scales_with_its_unit_and_ignores_signs_and_order(residual, factor):
    mad = mean_absolute_deviation(residual)
    np.testing.assert_allclose(mean_absolute_deviation(-factor * residual[:, ::-1]), factor * mad, rtol=1e-9)


@given(RESIDUALS, st.floats(0.0, 8.0))
def test_confidence_is_second_best_elsewhere_over_best(residual, apart_m):
    mad = mean_absolute_deviation(residual)
    position_m = np.stack([3.0 * np.arange(len(mad)), np.zeros(len(mad))], axis=1)
    choice = least_deviation(mad, position_m, apart_m)
    if np.isnan(mad).all():
        assert choice is None
        return
    assert choice is not None
    assert choice.mad_uT == np.nanmin(mad) == mad[choice.candidate]
    assert choice.ratio >= 1.0
    rivals = [m for k, m in enumerate(mad) if k != choice.candidate and 3 * abs(k - choice.candidate) >= apart_m]
    rivals = [m for m in rivals if m == m]
    if not rivals:
        assert choice.ratio == np.inf
    elif choice.mad_uT > 0.0:
        assert choice.ratio == pytest.approx(float(min(rivals)) / choice.mad_uT)


def test_parallel_track_of_the_truth_wins():
    """The thesis's 121 paths: the dead-reckoned track shifted by offsets of up to half a metre (Cuenca, L631)."""
    rng = np.random.default_rng(0)
    offsets = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 11)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    t = np.linspace(0.0, 1.0, 100)
    true_m = np.stack([3.0 * t, np.sin(3.0 * t)], axis=1)

    def norm_uT(p):
        return 48.0 + 4.0 * np.sin(1.3 * p[..., 0]) + 3.0 * np.cos(1.7 * p[..., 1] + p[..., 0])

    reading = norm_uT(true_m) + 0.1 * rng.normal(size=len(t))
    believed_m = true_m - [0.3, -0.2]
    residual = norm_uT(believed_m + offsets[:, None]) - reading
    choice = least_deviation(mean_absolute_deviation(residual[..., None]), offsets, 0.15)
    assert choice is not None
    np.testing.assert_allclose(offsets[choice.candidate], [0.3, -0.2], atol=0.101)
    assert choice.ratio > 1.2


def test_candidates_with_few_readings_do_not_win():
    residual = np.full((2, 10, 1), 1.0)
    residual[1] = np.nan
    residual[1, 0] = 0.01
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mad = mean_absolute_deviation(residual)
    assert mad[0] == 1.0
    assert np.isnan(mad[1])


def test_two_perfect_fits_are_not_told_apart():
    choice = least_deviation(np.zeros(2), np.array([[0.0], [9.0]]), 5.0)
    assert choice is not None
    assert choice.ratio == 1.0
