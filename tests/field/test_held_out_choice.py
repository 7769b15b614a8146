"""Hyper-parameters by surveys left out: walks whose labels err, and walks whose labels do not."""

from dataclasses import replace

import numpy as np
import pytest

from app.field.error_structure import LABELS_SD_M, POSE_LEAVES_M, ErrorStructure, as_a_pose_leaves_it, labels_err
from app.field.estimate import ambient_field_uT
from app.field.fit import fit_map
from app.field.hard_iron import HardIron
from app.field.held_out_choice import MOST_OBSERVATIONS, choose_by_held_out_surveys, held_out_nlpd
from app.field.learning import learn
from app.field.observations import Walk, observe
from app.field.samples import Samples
from app.field.spec import MapSpec
from app.field.tile_fit import FitState

SPEC = MapSpec(resolution_m=1.0)


def field_uT(p):
    x, y = p[:, 0], p[:, 1]
    return np.stack([6 * np.sin(x / 3), 25 + 6 * np.cos(y / 2.5), -40 + 6 * np.sin((x + y) / 4)], axis=1)


def straight_walks(rng, label_sd_m, count=12, step_m=0.25):
    """Straight walks across 24 x 24 m; the labels of each are shifted and their error swings within 4 m."""
    walks = {}
    for k in range(count):
        along = np.arange(0.0, 22.0, step_m)
        across = rng.uniform(2.0, 22.0)
        p = np.stack([along + 1.0, np.full(len(along), across)], axis=1)[:, :: 1 if k % 2 else -1]
        phase = rng.uniform(0, 2 * np.pi, 2)
        error = label_sd_m * (rng.standard_normal(2) + np.sin(along[:, None] / 4.0 + phase))
        B = field_uT(p) + 0.1 * rng.standard_normal((len(p), 3))
        labels = np.column_stack([p + error, np.full(len(p), 1.2)])
        walks[f"walk-{k:02d}"] = Samples(along, labels, B, "building")
    return walks


def learned_from(walks, spec=SPEC):
    observed = observe(walks, "vector", 0.2)
    return observed, learn(observed, ambient_field_uT(observed), spec, None, lambda *_: None)


@pytest.fixture(scope="module")
def vague():
    return learned_from(straight_walks(np.random.default_rng(0), 1.5))


def test_choice_predicts_left_out_surveys_and_new_walks_better_where_labels_err(vague):
    observed, learned = vague
    chosen = choose_by_held_out_surveys(observed, learned, SPEC, lambda *_: None)
    assert chosen is not learned
    assert held_out_nlpd(observed, chosen, SPEC) < held_out_nlpd(observed, learned, SPEC)
    fresh = straight_walks(np.random.default_rng(1), 1.5)
    walks = straight_walks(np.random.default_rng(0), 1.5)
    heights_m = np.array([1.2])
    nlpd = []
    for each in (chosen, learned):
        grid = fit_map(walks, SPEC, previous=FitState(each, heights_m, HardIron(), {})).grid
        found = [grid.at(walk.p_building_m) for walk in fresh.values()]
        near = np.concatenate([values.measured for values in found])
        error = np.concatenate([w.B_uT - v.mean_uT for w, v in zip(fresh.values(), found, strict=True)])[near]
        variance = np.concatenate([v.sd_uT**2 for v in found])[near] + grid.noise_sd_uT**2
        nlpd.append(np.mean(np.log(variance) + error**2 / variance))
    assert nlpd[0] < nlpd[1] + 0.02


def test_a_likelihood_that_takes_the_field_for_errors_does_not_compete(vague):
    """Of such a map nothing would count as measured, however well it predicts."""
    observed, learned = vague
    hyper = replace(learned.hyper, signal_sd_uT=0.2 * learned.hyper.signal_sd_uT, walk_ratio=20.0, bias_ratio=10.0)
    chosen = choose_by_held_out_surveys(observed, replace(learned, hyper=hyper), SPEC, lambda *_: None)
    was, now = hyper, chosen.hyper
    assert now.bias_ratio + now.walk_ratio + now.white_ratio < 1.0
    total = [np.square(h.signal_sd_uT) * (1 + h.bias_ratio + h.walk_ratio + h.white_ratio) for h in (was, now)]
    np.testing.assert_allclose(total[1], total[0])


def test_precise_walks_keep_the_most_likely():
    observed, learned = learned_from(straight_walks(np.random.default_rng(2), 0.0))
    assert choose_by_held_out_surveys(observed, learned, SPEC, lambda *_: None) is learned


def test_score_is_that_of_the_map_itself(vague):
    """One sample per observation: the leave-one-out score of the fitted map is the same figure, another way."""
    observed, learned = vague
    fitted = fit_map(
        straight_walks(np.random.default_rng(0), 1.5), SPEC, previous=FitState(learned, np.array([1.2]), HardIron(), {})
    )
    assert held_out_nlpd(observed, learned, SPEC) == pytest.approx(fitted.score.nlpd, rel=0.02)


def test_few_surveys_keep_the_most_likely(vague):
    observed, learned = vague
    assert choose_by_held_out_surveys(observed[:4], learned, SPEC, lambda *_: None) is learned


def test_white_noise_stays_white(vague):
    spec = MapSpec(resolution_m=1.0, noise="white")
    observed, learned = learned_from(straight_walks(np.random.default_rng(0), 1.5), spec)
    assert choose_by_held_out_surveys(observed, learned, spec, lambda *_: None).hyper.walk_ratio == 0.0


def test_a_large_map_is_judged_by_some_of_its_squares():
    """What is judged stays below a limit, and comes from all over the map."""
    from app.field.held_out_choice import _thinned

    rng = np.random.default_rng(3)
    walks = []
    for k in range(6):
        p = np.column_stack([rng.uniform(0, 1000.0, (10_000, 2)), np.full(10_000, 1.2)])
        field = np.zeros((10_000, 3))
        walks.append(Walk(str(k), p, field, np.arange(10_000.0), np.zeros(3), field, np.arange(10_000)))
    part = _thinned(walks)
    assert 0.8 * MOST_OBSERVATIONS < sum(map(len, part)) < 1.2 * MOST_OBSERVATIONS
    kept = np.concatenate([walk.position_m for walk in part])
    assert np.ptp(kept[:, 0]) > 900.0
    assert np.ptp(kept[:, 1]) > 900.0


def test_errors_of_labels_are_short_for_a_pose():
    """Where labels err, what a window's pose cannot take is short; where they do not, errors are what surveys show."""
    vague, precise = (fit_map(straight_walks(np.random.default_rng(0), sd_m), SPEC).grid for sd_m in (1.5, 0.0))
    assert labels_err(vague.noise_sd_uT, vague.prior_sd_uT)
    assert vague.error_structure.walk_length_m <= POSE_LEAVES_M
    assert vague.error_structure.position_sd_m == LABELS_SD_M
    assert not labels_err(precise.noise_sd_uT, precise.prior_sd_uT)
    assert not labels_err(np.full(3, 0.7), np.full(3, 1.0)), "a flat field: errors of any sensor are a large share"
    long = ErrorStructure(0.1, 0.7, 0.2, 3.0)
    assert precise.error_structure.position_sd_m == 0.0
    assert as_a_pose_leaves_it(long) == replace(long, walk_length_m=POSE_LEAVES_M, position_sd_m=LABELS_SD_M)
