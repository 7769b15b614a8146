"""The benchmark of availability against accuracy: its figures on made-up answers, and a few real windows."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st


@pytest.fixture(scope="module")
def availability(benchmark_named):
    return benchmark_named("availability")


def made_up(availability, sure, near, kind=0):
    """Windows of which every technique is as sure, and right, as the rows say: its own, or the first."""
    sure = {t: np.asarray(sure[k] if k < len(sure) else sure[0], dtype=float)
            for k, t in enumerate(availability.COMPARED)}  # fmt: skip
    error_m = {t: np.where(near[k] if k < len(near) else near[0], 0.1, np.inf)
               for k, t in enumerate(availability.COMPARED)}  # fmt: skip
    for technique in availability.TECHNIQUES:
        sure.setdefault(technique, sure[availability.POSTERIOR])
        error_m.setdefault(technique, error_m[availability.POSTERIOR])
    n = len(next(iter(sure.values())))
    return availability.Answered(availability.KINDS[kind], 2.0, sure, error_m, np.ones(n, dtype=bool))


@settings(deadline=None)
@given(
    sure=st.lists(st.integers(0, 5), min_size=1, max_size=30),
    share=st.floats(0.01, 1.0),
)
def test_the_surest_are_answered_and_ties_are_shared(availability, sure, share):
    sure = np.array(sure, dtype=float)
    weight = availability.answered_weights(sure, share)
    assert weight.sum() == pytest.approx(share * len(sure))
    assert ((weight >= -1e-9) & (weight <= 1.0 + 1e-9)).all()
    for level in np.unique(sure):
        assert np.ptp(weight[sure == level]) < 1e-9
        if (weight[sure == level] > 1e-9).any():
            assert np.allclose(weight[sure > level], 1.0)


def test_accuracy_rises_as_the_unsure_are_left_out(availability):
    answered = made_up(availability, [np.arange(10)], [np.arange(10) >= 5])
    for technique in (availability.DEFAULT_MLR, availability.DEFAULT_ABL, availability.POSTERIOR):
        assert availability.accuracy_at(answered, technique, 0.5) == 1.0
        assert availability.accuracy_at(answered, technique, 1.0) == 0.5
    assert availability.accuracy_at(answered, availability.RADIUS, 0.5) == 0.0  # a small radius is the surer one


def test_a_verdict_needs_two_standard_errors(availability, capsys):
    rng = np.random.default_rng(0)
    right = rng.random(400) < 0.5
    knows, guesses = np.where(right, 2.0, 1.0) + 0.1 * rng.random(400), rng.random(400)
    near = [right]
    better = made_up(availability, [guesses, knows, knows], near)
    assert availability.report_against_mlr(better)
    assert "better" in capsys.readouterr().out
    assert not availability.report_against_mlr(made_up(availability, [knows, guesses, guesses], near))
    assert availability.report_against_mlr(made_up(availability, [knows, guesses, knows], near))  # one of them suffices
    same = made_up(availability, [knows, knows, knows], near)
    assert availability.difference(same, availability.POSTERIOR, availability.DEFAULT_MLR, 0.5) == (0.0, 0.0)


@pytest.mark.parametrize("kind", range(3))
def test_a_few_windows_are_answered_in_every_way(availability, small_building, kind, tmp_path):
    building, floors = small_building
    part = availability.answer_windows(building, floors, 2, availability.KINDS[kind], 3.0, np.random.default_rng(0))
    assert len(part) == 2
    assert set(part.sure) == set(part.error_m) == set(availability.TECHNIQUES)
    for technique in availability.MLR:
        assert (part.sure[technique] >= 0.0).all()
    farther = [part.sure[technique] for technique in availability.MLR]
    assert all((a <= b * (1.0 + 1e-9)).all() | (b == 0.0).any() for a, b in pairwise(farther))
    for technique in (*availability.ABL_MASS, availability.POSTERIOR):
        assert ((part.sure[technique] >= 0.0) & (part.sure[technique] <= 1.0 + 1e-9)).all()
    assert availability.report([part], every_parameter=True) in (0, 1)
    availability.draw([part], tmp_path / "curves.png")
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("wrong", "reliable"), [(0, True), (5, True), (6, False)])
def test_of_a_hundred_fixes_five_may_be_wrong(availability, wrong, reliable):
    near = np.arange(100) >= wrong
    answered = made_up(availability, [np.ones(100)], [near])
    assert availability.report_shipped(answered) == reliable
