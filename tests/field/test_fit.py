from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.errors import IncompatibleFrames, InvalidInput, JobCancelled
from app.field.fit import fit_map
from app.field.samples import Samples
from app.field.spec import MapSpec

SPEC = MapSpec(resolution_m=0.5)


@pytest.fixture
def walks(room):
    return room.lanes(np.random.default_rng(1))


@pytest.fixture
def fitted(walks):
    return fit_map(walks, SPEC)


def points_inside(room):
    x, y = np.meshgrid(np.arange(0.5, room.width_m, 0.3), np.arange(0.5, room.depth_m, 0.3))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def same_grid(one, other, **tolerance):
    close = np.array_equal if not tolerance else lambda a, b: np.allclose(a, b, **tolerance)
    names = ("mean_uT", "sd_uT", "gradient_uT_per_m", "measured", "noise_sd_uT")
    return all(close(getattr(one, name), getattr(other, name)) for name in names)


def test_the_map_of_a_room_predicts_its_field_within_the_stated_uncertainty(room, walks):
    fitted = fit_map(walks, MapSpec(resolution_m=0.25))
    points = points_inside(room)
    values = fitted.grid.at(points)
    error = values.mean_uT - room.field_uT(points)
    assert values.measured.mean() > 0.95
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert np.mean(np.abs(error) <= 2 * values.sd_uT) > 0.9
    assert fitted.score is not None
    assert all(0.92 < c <= 1.0 for c in fitted.score.coverage_2sigma)


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
@pytest.mark.parametrize("kernel", ["squared_exponential", "matern52"])
def test_every_component_and_kernel_has_a_map(room, walks, components, kernel):
    fitted = fit_map(walks, MapSpec(components=components, kernel=kernel, resolution_m=0.5))
    points = points_inside(room)
    truth = Samples(np.arange(len(points)), points, room.field_uT(points), "building").features(components)
    error = fitted.grid.at(points).mean_uT - truth
    assert np.sqrt(np.mean(error**2)) < 0.25


def test_errors_along_the_walk_are_learned_and_keep_the_map_honest(room):
    rng = np.random.default_rng(4)
    walks = room.lanes(rng)
    for name, walk in walks.items():
        drift = np.zeros((len(walk), 3))
        for i in range(1, len(walk)):
            drift[i] = np.exp(-0.1 / 2.0) * drift[i - 1] + np.sqrt(1 - np.exp(-0.2 / 2.0)) * rng.normal(size=3)
        walks[name] = replace(walk, B_uT=walk.B_uT + drift)
    fitted = fit_map(walks, SPEC)
    assert max(fitted.hyperparameters["walk_noise_sd_ut"]) > 0.4
    points = points_inside(room)
    values = fitted.grid.at(points)
    error = values.mean_uT - room.field_uT(points)
    assert np.mean(np.abs(error) <= 2 * values.sd_uT) > 0.9
    assert all(0.92 < c < 0.99 for c in fitted.score.coverage_2sigma)


def test_standing_still_for_a_minute_adds_no_confidence(walks):
    victim = walks["survey-0"]
    at = len(victim) // 2
    repeats = np.ones(len(victim), dtype=int)
    repeats[at] = 3000
    index = np.repeat(np.arange(len(victim)), repeats)
    standing = Samples(0.02 * np.arange(len(index)), victim.p_building_m[index], victim.B_uT[index], "building")
    before, after = fit_map(walks, SPEC).grid, fit_map(walks | {"survey-0": standing}, SPEC).grid
    place = victim.p_building_m[at : at + 1]
    assert after.at(place).sd_uT == pytest.approx(before.at(place).sd_uT, rel=0.02)


def test_the_order_of_the_surveys_changes_no_bit(walks, fitted):
    again = fit_map(dict(reversed(walks.items())), SPEC)
    assert same_grid(again.grid, fitted.grid)
    assert again.hyperparameters == fitted.hyperparameters
    assert again.score == fitted.score
    assert again.consistency == fitted.consistency


@settings(max_examples=5, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(offset=st.tuples(*[st.floats(-30.0, 30.0)] * 3))
def test_a_constant_added_to_every_sample_is_added_to_the_mean(walks, fitted, offset):
    moved = {name: replace(walk, B_uT=walk.B_uT + offset) for name, walk in walks.items()}
    grid = fit_map(moved, SPEC).grid
    assert np.allclose(grid.mean_uT, fitted.grid.mean_uT + offset, atol=1e-3)
    assert np.allclose(grid.sd_uT, fitted.grid.sd_uT, rtol=1e-3)


def test_turning_the_components_turns_the_mean(walks, fitted):
    turned = {
        name: replace(walk, B_uT=np.column_stack([-walk.B_uT[:, 1], walk.B_uT[:, 0], walk.B_uT[:, 2]]))
        for name, walk in walks.items()
    }
    mean = fit_map(turned, SPEC).grid.mean_uT
    expected = np.stack(
        [-fitted.grid.mean_uT[..., 1], fitted.grid.mean_uT[..., 0], fitted.grid.mean_uT[..., 2]], axis=-1
    )
    assert np.allclose(mean, expected, atol=1e-3)


def test_the_gradient_of_the_grid_is_the_derivative_of_its_mean(walks):
    grid = fit_map(walks, MapSpec(resolution_m=0.05, components="norm")).grid
    inner = grid.measured[0, 1:-1, 1:-1]
    mean = grid.mean_uT[0, :, :, 0].astype(float)
    by_x = ((mean[1:-1, 2:] - mean[1:-1, :-2]) / 0.1)[inner]
    assert np.sqrt(np.mean(np.square(by_x - grid.gradient_uT_per_m[0, 1:-1, 1:-1, 0, 0][inner]))) < 0.02


def test_far_from_every_sample_the_map_is_the_prior_and_not_measured(walks):
    near = {"survey-0": walks["survey-0"]}
    far = replace(walks["survey-1"], p_building_m=walks["survey-1"].p_building_m + np.array([60.0, 0.0, 0.0]))
    grid = fit_map(near | {"survey-1": far}, SPEC).grid
    values = grid.at(np.array([[35.0, 5.0, 0.0]]))
    assert not values.measured[0]
    assert np.allclose(values.mean_uT, grid.ambient_uT, atol=1e-3)
    assert np.allclose(values.sd_uT, grid.prior_sd_uT, rtol=1e-3)


def test_a_single_survey_has_a_map_but_no_score(walks):
    fitted = fit_map({"only": walks["survey-0"]}, SPEC)
    assert fitted.score is None
    assert "second walk" in fitted.score_reason
    assert fitted.grid.error_correlation_m == 0.0
    assert fitted.consistency["only"].status == "unjudged"


def test_the_exact_engine_gives_the_same_map(make_room):
    room = make_room(7)
    rng = np.random.default_rng(1)
    walks = {
        str(k): room.walk(rng, np.array([[0.5, y], [5.0, y], [5.0, y + 1.0], [0.5, y + 1.0]]))
        for k, y in enumerate((1.0, 1.4, 1.8))
    }
    exact = fit_map(walks, MapSpec(engine="exact", resolution_m=0.5))
    hilbert = fit_map(walks, SPEC)
    points = np.column_stack([rng.uniform(0.8, 4.7, 200), rng.uniform(1.0, 2.8, 200), np.zeros(200)])
    truth = room.field_uT(points)
    errors = [np.sqrt(np.mean(np.square(m.grid.at(points).mean_uT - truth))) for m in (exact, hilbert)]
    assert max(errors) < 0.25
    assert exact.hyperparameters["engine"] == "exact"
    assert exact.score.held_out_samples == hilbert.score.held_out_samples


def test_a_flat_field_has_a_flat_map(walks):
    flat = {name: replace(walk, B_uT=np.full_like(walk.B_uT, 20.0)) for name, walk in walks.items()}
    grid = fit_map(flat, SPEC).grid
    assert np.allclose(grid.mean_uT, 20.0, atol=0.01)
    assert np.isfinite(grid.sd_uT).all()


def test_progress_rises_and_a_cancelled_job_stops(walks):
    seen = []
    fit_map(walks, SPEC, lambda fraction, message: seen.append(fraction))
    assert seen == sorted(seen)
    assert seen[0] >= 0.0
    assert seen[-1] <= 1.0

    def cancel(fraction, message):
        if fraction > 0.5:
            raise JobCancelled("asked to stop")

    with pytest.raises(JobCancelled):
        fit_map(walks, SPEC, cancel)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        (MapSpec(heights_m=(1.5, 0.5)), "rising order"),
        (MapSpec(heights_m=()), "one or more heights"),
        (MapSpec(curl_free=True, components="norm"), "components vector"),
        (MapSpec(curl_free=True, engine="exact"), "engine hilbert"),
        (MapSpec(engine="exact", kernel="matern32+matern32"), "one length"),
        (MapSpec(resolution_m=0.0), "resolution_m"),
        (MapSpec(resolution_m=float("nan")), "resolution_m"),
        (MapSpec(resolution_m=0.001), "cells"),
    ],
)
def test_parameters_that_make_no_map_are_refused(walks, spec, words):
    with pytest.raises(InvalidInput, match=words):
        fit_map(walks, spec)


def test_too_little_to_fit_is_refused(walks):
    few = walks["survey-0"]
    three = Samples(few.t_s[:3], few.p_building_m[:3], few.B_uT[:3], "building")
    for nothing in ({}, {"a": three}, {"a": Samples(few.t_s[:0], few.p_building_m[:0], few.B_uT[:0], "building")}):
        with pytest.raises(InvalidInput, match="longer walks"):
            fit_map(nothing, SPEC)


def test_the_exact_engine_says_when_it_is_too_much(room):
    walks = room.lanes(np.random.default_rng(1), lane_m=0.5)
    with pytest.raises(InvalidInput, match="hilbert"):
        fit_map(walks, MapSpec(engine="exact"))


def test_a_level_walk_cannot_give_a_vector_map(walks):
    with pytest.raises(IncompatibleFrames):
        fit_map(walks | {"level": replace(walks["survey-0"], frame="level")}, SPEC)


def test_a_single_height_is_where_the_layer_lies(walks):
    assert fit_map(walks, MapSpec(resolution_m=0.5, heights_m=(0.8,))).grid.heights_m.tolist() == [0.8]
    assert fit_map(walks, SPEC).grid.heights_m.tolist() == [0.0]
