from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from app.errors import InvalidInput
from app.field.fit import fit_map
from app.field.hard_iron import Cleaned, HardIron
from app.field.hilbert_engine import estimate_by_hilbert
from app.field.hyperparameters import Hyperparameters
from app.field.label_errors import LABEL_LENGTH_M, LABEL_SD_M, LARGEST_M, displacements, fit_labels, label_prior
from app.field.observations import Walk, observe
from app.field.others import FromOthers, predict_from_others
from app.field.spec import MapSpec

SPEC = MapSpec(resolution_m=0.5, refine=True)
COMPONENTS = (0, 1, 2)


def with_wrong_labels(walks, sd_m, seed=3):
    """The walks with labels off by smooth errors of this sd per axis, and the errors."""
    rng = np.random.default_rng(seed)
    wrong, errors = {}, {}
    for name, walk in walks.items():
        functions = label_prior(walk.path_length_m())
        errors[name] = sd_m / LABEL_SD_M * functions @ rng.normal(size=(functions.shape[1], 2))
        wrong[name] = replace(walk, p_building_m=walk.p_building_m + np.pad(errors[name], ((0, 0), (0, 1))))
    return wrong, errors


def faint(walks, share):
    """The same walks in a field whose steel is weaker, beside the same noise."""
    rng = np.random.default_rng(4)
    return {
        name: replace(walk, B_uT=np.array([18.0, 3.0, -44.0]) * (1.0 - share) + share * walk.B_uT
                      + 0.3 * rng.normal(size=walk.B_uT.shape))
        for name, walk in walks.items()
    }  # fmt: skip


def coarse(walks):
    observed = observe(walks, "vector", 0.6)
    plain = replace(SPEC, refine=False)
    estimate = estimate_by_hilbert(observed, Cleaned(walks, HardIron(), {}), plain, None, lambda f, text: None)
    return observed, estimate


def test_wrong_labels_are_corrected_and_the_map_comes_nearer_to_the_truth(make_room):
    room = make_room(7)
    walks, _ = with_wrong_labels(room.lanes(np.random.default_rng(1), surveys=8, lane_m=2.0), sd_m=0.35)
    refined, plain = (fit_map(walks, replace(SPEC, refine=each)) for each in (True, False))
    report = refined.hyperparameters["refinement"]
    assert report["applied"], report["reason"]
    assert report["recovered_share"] > 0.5
    assert report["untouched_gain_nats"]["significant"]
    assert report["unseen_error_falls_by"]["value"] > 0.1
    assert all(0.05 < rms_m <= LARGEST_M for rms_m in report["correction_rms_m"].values())
    x, y = np.meshgrid(np.arange(1.0, room.width_m - 1.0, 0.5), np.arange(1.0, room.depth_m - 1.0, 0.5))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    def rmse(fitted):
        return np.sqrt(np.mean(np.square(fitted.grid.at(points).mean_uT - room.field_uT(points))))

    assert rmse(refined) < 0.85 * rmse(plain)
    assert refined.state is None
    assert refined.score.rmse_vec_ut > 0.8 * plain.score.rmse_vec_ut  # labels that judge are as wrong as before


@pytest.mark.slow
def test_walks_in_a_weak_field_stay_as_they_are(room):
    strong = room.lanes(np.random.default_rng(1), surveys=5, lane_m=2.5, noise_uT=0.0)
    walks, _ = with_wrong_labels(faint(strong, share=0.05), sd_m=0.35)
    refined, plain = (fit_map(walks, replace(SPEC, refine=each)) for each in (True, False))
    assert not refined.hyperparameters["refinement"]["applied"]
    assert "come out again" in refined.hyperparameters["refinement"]["reason"]
    assert np.array_equal(refined.grid.mean_uT, plain.grid.mean_uT)
    assert refined.score == plain.score


def test_walks_of_different_buildings_are_not_made_to_agree(make_room):
    walks = {}
    for k in range(5):
        here = make_room(20 + k).lanes(np.random.default_rng(k), surveys=5, lane_m=2.5)
        walks[f"survey-{k}"] = here[f"survey-{k}"]
    report = fit_map(walks, SPEC).hyperparameters["refinement"]
    assert not report["applied"]
    assert not report["untouched_gain_nats"]["significant"]


def test_norms_have_no_second_component_to_judge_by(room):
    walks = room.lanes(np.random.default_rng(1), surveys=2, lane_m=3.0)
    report = fit_map(walks, replace(SPEC, components="norm")).hyperparameters["refinement"]
    assert not report["applied"]
    assert "no second component" in report["reason"]
    assert report["unseen_error_falls_by"] is None


def test_walks_that_never_meet_or_one_alone_are_not_refined(room):
    walks = room.lanes(np.random.default_rng(1), surveys=2, lane_m=4.0)
    away = replace(walks["survey-1"], p_building_m=walks["survey-1"].p_building_m + np.array([50.0, 0.0, 0.0]))
    for each in ({"a": walks["survey-0"]}, {"a": walks["survey-0"], "b": away}):
        report = fit_map(each, SPEC).hyperparameters["refinement"]
        assert report["reason"] == "no two surveys come within a metre of each other"


def test_only_the_default_engine_refines(room):
    with pytest.raises(InvalidInput, match="engine hilbert"):
        fit_map(room.lanes(np.random.default_rng(1)), replace(SPEC, engine="exact"))


def test_prediction_from_the_others_is_the_leave_one_out_prediction_with_its_gradient(room):
    walks = room.lanes(np.random.default_rng(1), surveys=3, lane_m=2.0)
    observed, estimate = coarse(walks)
    learned = estimate.state.learned
    found = predict_from_others(observed, learned, set(walks))
    for walk in observed:
        name = walk.survey_id
        assert np.allclose(found[name].mean_uT, estimate.held_out_mean_uT[name] + estimate.ambient_uT, atol=1e-8)
        variance = estimate.held_out_variance_ratio[name] * np.square(estimate.prior_sd_uT)
        assert np.allclose(found[name].variance_uT2, variance, atol=1e-8)

    first = observed[0].survey_id
    for axis in (0, 1):
        step = np.zeros(3)
        step[axis] = 0.02
        low, high = (
            predict_from_others([replace(observed[0], position_m=observed[0].position_m + by), *observed[1:]],
                                learned, set(walks))[first].mean_uT
            for by in (-step, step)
        )  # fmt: skip
        assert np.allclose((high - low) / 0.04, found[first].gradient_uT_per_m[:, :, axis], atol=0.06)


def test_walks_outside_the_mapping_teach_nothing(room):
    walks = room.lanes(np.random.default_rng(1), surveys=3, lane_m=2.0)
    observed, estimate = coarse(walks)
    learned, mapping = estimate.state.learned, {"survey-1", "survey-2"}
    other = [replace(observed[0], field_uT=observed[0].field_uT + 30.0), *observed[1:]]
    one, two = (predict_from_others(each, learned, mapping) for each in (observed, other))
    assert all(np.array_equal(one[name].mean_uT, two[name].mean_uT) for name in walks)


def some_fit(rng, n):
    path_m = np.cumsum(rng.uniform(0.3, 0.7, n))
    hyper = Hyperparameters("matern32", 3.0, np.array([4.0, 3.0, 5.0]), white_ratio=0.02, bias_ratio=0.05,
                            walk_ratio=0.1, walk_length_m=2.0)  # fmt: skip
    none = np.zeros((n, 3))
    walk = Walk("a", none, rng.normal(size=(n, 3)), path_m, np.zeros(3), none, np.arange(n))
    others = FromOthers(none, rng.uniform(0.1, 2.0, (n, 1)) * np.square(hyper.signal_sd_uT), rng.normal(size=(n, 3, 2)))
    return walk, others, hyper


def test_the_likeliest_displacement_is_the_dense_gaussian_conditional():
    n = 25
    walk, others, hyper = some_fit(np.random.default_rng(0), n)
    prior = label_prior(walk.path_m)
    prior_m2 = np.kron(np.eye(2), prior @ prior.T)
    apart_m = np.abs(walk.path_m[:, None] - walk.path_m[None])
    signal_sd_uT = hyper.signal_sd_uT[COMPONENTS,]
    latent_sd = np.sqrt(others.variance_uT2[:, 0]) / signal_sd_uT[0]
    noise = 0.05 + 0.5 * (0.1 * np.exp(-apart_m / 2.0) + 0.02 * np.eye(n))
    noise += np.outer(latent_sd, latent_sd) * np.exp(-apart_m / 3.0)
    slopes = np.vstack([
        np.hstack([np.diag(others.gradient_uT_per_m[:, c, d]) for d in (0, 1)]) for c in COMPONENTS
    ])  # fmt: skip
    covariance = slopes @ prior_m2 @ slopes.T + np.kron(np.diag(np.square(signal_sd_uT)), noise)
    residual = walk.field_uT.T.ravel()
    wanted = prior_m2 @ slopes.T @ np.linalg.solve(covariance, residual)
    found = fit_labels(walk, others, np.zeros((n, 2)), hyper, 0.5, COMPONENTS)
    assert np.allclose(found.displacement_m, wanted.reshape(2, n).T, atol=1e-9)
    scaled = np.repeat(1.0 / signal_sd_uT, n)
    density = multivariate_normal.logpdf(scaled * residual, cov=covariance * np.outer(scaled, scaled))
    assert found.log_likelihood == pytest.approx(density + 0.5 * 3 * n * np.log(2 * np.pi), rel=1e-9)


def test_linearised_at_the_answer_of_a_straight_field_the_answer_stays():
    walk, others, hyper = some_fit(np.random.default_rng(1), 30)
    first = fit_labels(walk, others, np.zeros((30, 2)), hyper, 1.0, COMPONENTS).displacement_m
    there = others._replace(mean_uT=others.mean_uT + np.einsum("ncd,nd->nc", others.gradient_uT_per_m, first))
    assert np.allclose(fit_labels(walk, there, first, hyper, 1.0, COMPONENTS).displacement_m, first, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(length_m=st.floats(0.5, 300.0), seed=st.integers(0, 100))
def test_errors_of_labels_are_smooth_of_the_stated_sd_and_length(length_m, seed):
    path_m = np.sort(np.random.default_rng(seed).uniform(0.0, length_m, 40))
    prior = label_prior(path_m)
    wanted = LABEL_SD_M**2 * np.exp(-0.5 * np.square((path_m[:, None] - path_m) / LABEL_LENGTH_M))
    assert np.allclose(prior @ prior.T, wanted, atol=0.03 * LABEL_SD_M**2)


def test_no_correction_is_larger_than_the_bound(room):
    walks = room.lanes(np.random.default_rng(1), surveys=3, lane_m=2.0)
    wrong, _ = with_wrong_labels(walks, sd_m=3.0)
    observed, estimate = coarse(wrong)
    found = displacements(observed, estimate.state.learned, COMPONENTS)
    largest_m = max(float(np.linalg.norm(d, axis=1).max()) for d in found.values())
    assert 0.5 < largest_m <= LARGEST_M + 1e-12
