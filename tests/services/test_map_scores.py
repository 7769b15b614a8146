"""Scores of a map on held-out walks: drawn errors whose figures are known, and standard errors against repetition."""

import numpy as np
import pytest
from scipy.stats import spearmanr

from app.field.body_bias import BodyBias
from app.field.grid import FieldGrid
from app.field.samples import Samples
from app.services.map_scores import HeldOutWalk, held_out_walk, nlpd_gain, score_map


def walks(rng, count=30, n=40, common_uT=2.0):
    """Errors of every walk: one constant and white ones, predicted with the right variance."""
    made = []
    for _ in range(count):
        sd = rng.uniform(0.5, 3.0, (n, 2))
        error = common_uT * rng.standard_normal(2) + sd * rng.standard_normal((n, 2))
        made.append(HeldOutWalk(error, sd**2 + common_uT**2, sd))
    return made


def test_figures_of_drawn_errors():
    made = walks(np.random.default_rng(0), count=200, n=40)
    found = score_map(made)
    error = np.concatenate([walk.error_uT for walk in made])
    assert (found.samples, found.walks) == (8_000, 200)
    assert found.rmse_ut == pytest.approx(np.sqrt(np.mean(error**2, axis=0)))
    for component, coverage in enumerate(found.coverage_2sigma):
        assert coverage.value == pytest.approx(0.9545, abs=0.015)
        assert found.robust_sd_ut[component].value == pytest.approx(1.4826 * np.median(np.abs(error[:, component])))
    sd = np.concatenate([walk.latent_sd_uT for walk in made])
    expected = np.mean([spearmanr(np.abs(error[:, c]), sd[:, c]).statistic for c in range(2)])
    assert found.rank_correlation.value == pytest.approx(expected)
    assert found.rank_correlation.value > 0.1


@pytest.mark.slow
def test_standard_errors_are_those_of_repetitions():
    rng = np.random.default_rng(1)
    repeated = [score_map(walks(rng)) for _ in range(30)]
    for figure in (lambda s: s.nlpd, lambda s: s.robust_sd_ut[0], lambda s: s.coverage_2sigma[1]):
        stated = np.mean([figure(s).standard_error for s in repeated])
        assert stated == pytest.approx(np.std([figure(s).value for s in repeated]), rel=0.4)


def test_the_right_variance_gains_over_a_wrong_one():
    made = walks(np.random.default_rng(2))
    narrow = [HeldOutWalk(w.error_uT, w.variance_uT2 / 9.0, w.latent_sd_uT) for w in made]
    gain = nlpd_gain(made, narrow)
    assert gain.value == pytest.approx(score_map(narrow).nlpd.value - score_map(made).nlpd.value)
    assert gain.value > 4 * gain.standard_error
    assert nlpd_gain(narrow, made).value == pytest.approx(-gain.value)


def test_one_walk_has_no_standard_error_and_none_has_no_score():
    made = walks(np.random.default_rng(3), count=1)
    empty = HeldOutWalk(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, 2)))
    assert score_map([*made, empty]).nlpd.standard_error is None
    assert score_map([*made, empty]).nlpd.text(1).count("±") == 0
    assert score_map([empty]) is None
    assert nlpd_gain([empty], [empty]) is None


def test_only_places_near_a_mapping_walk_are_judged_with_all_that_is_uncertain():
    shape = (1, 4, 12, 3)
    grid = FieldGrid(
        components="vector",
        origin_m=(0.0, 0.0),
        resolution_m=1.0,
        heights_m=np.array([1.2]),
        mean_uT=np.full(shape, 5.0, dtype=np.float32),
        sd_uT=np.full(shape, 1.0, dtype=np.float32),
        gradient_uT_per_m=np.zeros((*shape, 2), dtype=np.float32),
        measured=np.ones(shape[:3], dtype=np.bool_),
        ambient_uT=np.zeros(3),
        prior_sd_uT=np.ones(3),
        noise_sd_uT=np.full(3, 2.0),
    )
    p = np.array([[1.0, 1.0, 1.2], [5.0, 1.0, 1.2], [9.0, 1.0, 1.2]])
    walk = Samples(
        np.arange(3.0), p, np.tile([6.0, 5.0, 4.0], (3, 1)), "building", np.tile([1.0, 0, 0, 0], (3, 1)), "s"
    )
    mapped = np.array([[1.0, 1.9], [5.0, 2.1]])
    plain = held_out_walk(grid, walk, mapped, None)
    np.testing.assert_allclose(plain.error_uT, [[1.0, 0.0, -1.0]])
    np.testing.assert_allclose(plain.variance_uT2, [[5.0, 5.0, 5.0]])
    known = held_out_walk(grid, walk, mapped, BodyBias(np.zeros(3), np.diag([1.0, 2.0, 3.0])))
    np.testing.assert_allclose(known.variance_uT2, [[6.0, 7.0, 8.0]])
    np.testing.assert_allclose(known.latent_sd_uT, 1.0)
