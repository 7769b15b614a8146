"""Offsets of calibration sessions, found where walks meet: known offsets on a known field."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.field.body_bias import BodyBias
from app.field.samples import Samples
from app.field.session_bias import (
    PRIOR_SCALE_UT,
    PRIOR_VERTICAL_SCALE_UT,
    estimate_session_biases,
    offset_variance_uT2,
    remove_session_biases,
)

BIASES = {"a": [0.0, 0.0, 0.0], "b": [4.0, -3.0, 0.0], "c": [-11.0, 38.0, 0.0]}


def field_uT(p):
    return np.stack([5 * np.sin(p[:, 0] / 6), 25 + 5 * np.cos(p[:, 1] / 5), -40 + 0 * p[:, 0]], axis=1)


def make_walks(rng, noise_uT=0.5, label_m=0.5, count=18):
    """Straight walks across a 30 x 30 m hall in every direction, sessions in turn, labels half a metre wrong."""
    walks = {}
    for k in range(count):
        angle = rng.uniform(0, 2 * np.pi)
        along = np.arange(-12.0, 12.0, 0.1)
        p = np.stack([15 + along * np.cos(angle), 15 + along * np.sin(angle)], axis=1) + rng.uniform(-4, 4, 2)
        session = "abc"[k % 3]
        n = len(p)
        attitude = Rotation.from_euler("z", angle - np.pi / 2) * Rotation.from_euler("x", 0.3)
        B = field_uT(p) + attitude.apply(BIASES[session]) + noise_uT * rng.standard_normal((n, 3))
        label = np.column_stack([p + label_m * rng.standard_normal(2), np.full(n, 1.2)])
        q = np.tile(attitude.as_quat(scalar_first=True), (n, 1))
        walks[f"walk-{k:02d}"] = Samples(along + 12.0, label, B, "building", q, session)
    return walks


def test_known_offsets_are_found_within_their_deviation():
    found = estimate_session_biases(make_walks(np.random.default_rng(3)))
    for name, bias in BIASES.items():
        error = found[name].bias_body_uT - bias
        assert np.all(np.abs(error[:2]) < 1.0)
        assert np.all(np.abs(error) < 4 * found[name].sd_uT)


def test_walks_agree_once_their_offsets_are_out():
    walks = make_walks(np.random.default_rng(4))
    cleaned = remove_session_biases(walks, estimate_session_biases(walks))
    for name, samples in cleaned.items():
        error = samples.B_uT - field_uT(samples.p_building_m)
        assert np.abs(error[:, :2].mean(axis=0)).max() < 1.5, name
        assert samples.session == walks[name].session


def test_a_session_that_meets_nobody_stays_as_it_was():
    walks = make_walks(np.random.default_rng(5))
    far = walks["walk-00"]
    alone = Samples(far.t_s, far.p_building_m + 500.0, far.B_uT, "building", far.q_body_to_building, "alone")
    found = estimate_session_biases({**walks, "alone": alone})["alone"]
    np.testing.assert_array_equal(found.bias_body_uT, 0.0)
    across, vertical = PRIOR_SCALE_UT * np.sqrt(3.0), PRIOR_VERTICAL_SCALE_UT * np.sqrt(3.0)
    spread = np.sqrt(np.linalg.eigvalsh(found.covariance_uT2))
    np.testing.assert_allclose(spread, [vertical, across, across])


def test_walks_without_session_or_attitude_are_left_alone():
    walk = make_walks(np.random.default_rng(6))["walk-01"]
    plain = Samples(walk.t_s, walk.p_building_m, walk.B_uT, "building")
    assert estimate_session_biases({"plain": plain}) == {}
    biases = estimate_session_biases({"walk": walk})
    assert remove_session_biases({"plain": plain}, biases)["plain"] is plain


@pytest.mark.parametrize("seed", range(3))
def test_order_of_the_walks_does_not_matter(seed):
    walks = make_walks(np.random.default_rng(seed), count=9)
    forth = estimate_session_biases(walks)
    back = estimate_session_biases(dict(reversed(walks.items())))
    for name in forth:
        np.testing.assert_array_equal(forth[name].bias_body_uT, back[name].bias_body_uT)


def test_what_is_left_of_every_survey_is_as_large_as_said():
    walks = make_walks(np.random.default_rng(7))
    biases = estimate_session_biases(walks)
    for name, samples in remove_session_biases(walks, biases).items():
        variance = offset_variance_uT2(samples, biases[samples.session], "vector").mean(axis=0)
        left = (samples.B_uT - field_uT(samples.p_building_m)).mean(axis=0)
        assert np.all(np.abs(left[:2]) < 4 * np.sqrt(variance[:2] + 1.0)), name


def test_one_session_alone_tells_its_offset_by_walking_both_ways():
    walks = {name: s for name, s in make_walks(np.random.default_rng(8)).items() if s.session == "c"}
    biases = estimate_session_biases(walks)
    assert set(biases) == {"c"}
    np.testing.assert_allclose(biases["c"].bias_body_uT[:2], BIASES["c"][:2], atol=5.0)


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
def test_variance_left_is_that_of_the_features_of_drawn_offsets(components):
    """Against a naive second way: draw offsets, turn them into the building, take the features again."""
    rng = np.random.default_rng(9)
    walk = make_walks(rng)["walk-02"]
    root = 0.3 * rng.standard_normal((3, 3))
    drawn = rng.standard_normal((4000, 3)) @ root.T
    turn = Rotation.from_quat(walk.q_body_to_building[0], scalar_first=True)
    features = [
        Samples(walk.t_s[:1], walk.p_building_m[:1], walk.B_uT[:1] + turn.apply(b), "building").features(components)[0]
        for b in drawn
    ]
    found = offset_variance_uT2(walk, BodyBias(np.zeros(3), root @ root.T), components)
    assert found.shape == walk.features(components).shape
    np.testing.assert_allclose(found[0], np.var(features, axis=0), rtol=0.1)
