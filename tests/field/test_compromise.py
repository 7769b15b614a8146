"""The compromise map against the intermediate one it is told from, naive formulae, and the seed's own counts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from app.field import compromise_engine
from app.field.compromise import STUDY_SPACINGS_M, compromise, interpolate, naive_nodes, spanning_nodes, study_density
from app.field.exact import ExactProcess
from app.field.fit import fit_map
from app.field.kernels import covariance
from app.field.spec import MapSpec
from app.synthetic.room import (
    LOWER_FOUR_M,
    TAKE_OFF_M,
    TRAINING_BOX_M,
    UPPER_FOUR_M,
    UTILIZATION_BOX_M,
    box_grid_m,
    fly,
    make_room,
)

PROCESS = ExactProcess("squared_exponential", length_m=0.92, signal_sd_uT=3.4, noise_sd_uT=0.28)
REFERENCE_NODES_M = np.concatenate([spanning_nodes(TRAINING_BOX_M, (0.5, 0.5, 0.25)), TAKE_OFF_M])


@pytest.fixture(scope="module")
def intermediate():
    """Of the x component of eight flights, hyper-parameters as maximum likelihood finds them for it."""
    rng = np.random.default_rng(4)
    room = make_room(rng)
    flights = [fly(room, altitudes, rng) for altitudes in (LOWER_FOUR_M, UPPER_FOUR_M)]
    field_uT = np.concatenate([flight.B_uT[:, 0] for flight in flights])
    return PROCESS.condition(np.concatenate([f.p_building_m for f in flights]), field_uT - np.median(field_uT))


@pytest.fixture(scope="module")
def points_m():
    return np.random.default_rng(1).uniform(*UTILIZATION_BOX_M, (500, 3))


def test_the_reference_grid_has_the_seeds_511_nodes():
    assert len(REFERENCE_NODES_M) == 504 + 7
    assert cdist(REFERENCE_NODES_M, REFERENCE_NODES_M)[np.triu_indices(511, 1)].min() > 0.05
    assert np.any(np.all(np.isclose(REFERENCE_NODES_M, [0.0, 0.0, 0.5]), axis=1))


def test_naive_nodes_reproduce_the_seeds_counts():
    counts = [len(naive_nodes(TRAINING_BOX_M, (spacing,) * 3)) + 7 for spacing in STUDY_SPACINGS_M]
    # Kuevor, L822
    assert counts == [3031, 1775, 931, 655, 447, 259, 259, 199, 133, 112, 97, 97, 79, 67, 47, 47, 47]


@given(
    size_m=st.tuples(*[st.floats(0.0, 6.0)] * 3),
    spacing_m=st.tuples(*[st.floats(0.2, 2.0)] * 3),
)
def test_spanning_nodes_reach_every_face_and_are_close_enough(size_m, spacing_m):
    box_m = np.array([[1.0, -2.0, 0.5], np.add([1.0, -2.0, 0.5], size_m)])
    nodes_m = spanning_nodes(box_m, spacing_m)
    for axis in range(3):
        along = np.unique(nodes_m[:, axis])
        if size_m[axis] < spacing_m[axis] / 2.0:
            assert along.tolist() == [pytest.approx(box_m[:, axis].mean())]
        else:
            assert along[[0, -1]] == pytest.approx(box_m[:, axis])
            assert np.diff(along).max() <= spacing_m[axis] + 1e-6


def test_mean_and_variance_are_those_of_the_formula(points_m):
    """B10 written out with inverses, for few nodes."""
    rng = np.random.default_rng(0)
    seen_m, nodes_m = rng.uniform(*TRAINING_BOX_M, (80, 3)), rng.uniform(*TRAINING_BOX_M, (25, 3))
    y = rng.normal(size=80)
    told = compromise(PROCESS.condition(seen_m, y), nodes_m)

    def k(a, b):
        return PROCESS.signal_sd_uT**2 * covariance(PROCESS.kernel, cdist(a, b), PROCESS.length_m)

    measured = np.linalg.inv(k(seen_m, seen_m) + PROCESS.noise_sd_uT**2 * np.eye(80))
    prior = np.linalg.inv(k(nodes_m, nodes_m))
    answers = k(nodes_m, seen_m) @ measured @ y
    posterior = k(nodes_m, nodes_m) - k(nodes_m, seen_m) @ measured @ k(seen_m, nodes_m)
    across = k(points_m, nodes_m)
    forgotten = prior @ (k(nodes_m, nodes_m) - posterior) @ prior
    variance = PROCESS.signal_sd_uT**2 - np.einsum("ni,ij,nj->n", across, forgotten, across)
    mean, ratio = told.at(points_m)
    assert np.allclose(mean, across @ prior @ answers, atol=1e-5)
    assert np.allclose(ratio * PROCESS.signal_sd_uT**2, variance, atol=1e-5)


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32", "matern52"])
def test_told_at_the_observations_themselves_it_is_the_intermediate_map(kernel, points_m):
    rng = np.random.default_rng(0)
    seen_m = box_grid_m(TRAINING_BOX_M, (6, 5, 3)) + rng.normal(0.0, 0.05, (90, 3))
    intermediate = ExactProcess(kernel, 0.9, 3.0, 0.3).condition(seen_m, rng.normal(size=90))
    told = compromise(intermediate, seen_m)
    for ours, its in zip(told.at(points_m), intermediate.at(points_m), strict=True):
        assert np.allclose(ours, its, atol=1e-5)
    assert np.allclose(told.mean_at(points_m), told.at(points_m)[0])
    assert np.allclose(told.mean_at(points_m), interpolate(intermediate, seen_m).mean_at(points_m))


def test_the_seeds_variant_takes_predictions_for_observations(intermediate, points_m):
    told = compromise(intermediate, REFERENCE_NODES_M, with_covariance=False)
    again = PROCESS.condition(REFERENCE_NODES_M, intermediate.at(REFERENCE_NODES_M)[0])
    assert np.allclose(told.at(points_m), again.at(points_m))


def test_with_covariance_nothing_is_lost_at_the_reference_nodes(intermediate, points_m):
    """The seed's smooths again and forgets how sure the intermediate map was; dense nodes make it too sure."""
    mean, ratio = intermediate.at(points_m)

    def told(nodes_m, with_covariance):
        its_mean, its_ratio = compromise(intermediate, nodes_m, with_covariance).at(points_m)
        return np.sqrt(np.mean(np.square(its_mean - mean))), np.mean(np.sqrt(its_ratio)) / np.mean(np.sqrt(ratio))

    kept, kept_sd = told(REFERENCE_NODES_M, True)
    seeds, seeds_sd = told(REFERENCE_NODES_M, False)
    assert kept < 0.013 < seeds
    assert kept_sd == pytest.approx(1.0, abs=0.05)
    assert seeds_sd > 1.1
    dense = spanning_nodes(TRAINING_BOX_M, (0.3,) * 3)
    assert told(dense, False)[1] < 0.85
    assert told(dense, True)[1] == pytest.approx(1.0, abs=0.01)


def test_the_gradient_is_the_means(intermediate, points_m):
    told, step = compromise(intermediate, REFERENCE_NODES_M), 1e-4 * np.eye(3)
    gradient = told.gradient_at(points_m)
    for axis in range(gradient.shape[1]):
        slope = (told.mean_at(points_m + step[axis]) - told.mean_at(points_m - step[axis])) / 2e-4
        assert np.allclose(gradient[:, axis], slope, atol=1e-4)


def test_density_does_not_matter_up_to_half_a_length(intermediate):
    rng = np.random.default_rng(9)
    flight = fly(make_room(np.random.default_rng(4)), (0.75, 1.5, 2.0), rng)
    deviation = flight.B_uT[:, :1] - np.median(flight.B_uT[:, 0])
    grids = [(s, spanning_nodes(TRAINING_BOX_M, (s,) * 3)) for s in STUDY_SPACINGS_M[2:]]
    rows = study_density([intermediate], grids, [(flight.p_building_m, deviation)])
    rmse = np.array([row.rmse_vec_uT[0] for row in rows])
    fine = np.array([row.spacing_m <= PROCESS.length_m / 2.0 for row in rows])
    assert [row.nodes for row in rows] == [len(nodes) for _, nodes in grids]
    assert np.ptp(rmse[fine]) < 0.01
    assert rmse[-1] > 1.2 * rmse[0]


SPEC = MapSpec(engine="compromise", kernel="squared_exponential", resolution_m=0.5)


@pytest.fixture
def walks(make_room):
    room, rng = make_room(7), np.random.default_rng(1)
    return {
        str(k): room.walk(rng, np.array([[0.5, y], [5.0, y], [5.0, y + 1.0], [0.5, y + 1.0]]))
        for k, y in enumerate((1.0, 1.4, 1.8))
    }


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32"])
def test_the_engine_gives_the_exact_engines_map(walks, kernel):
    exact, told = (
        fit_map(walks, MapSpec(engine=engine, kernel=kernel, resolution_m=0.5)) for engine in ("exact", "compromise")
    )
    points_m = np.column_stack([np.random.default_rng(0).uniform([0.8, 1.0], [4.7, 2.8], (200, 2)), np.zeros(200)])
    a, b = (fitted.grid.at(points_m) for fitted in (exact, told))
    assert np.sqrt(np.mean(np.square(a.mean_uT - b.mean_uT))) < 0.1
    assert np.mean(b.sd_uT) == pytest.approx(np.mean(a.sd_uT), rel=0.1)
    assert np.allclose(told.score.rmse_ut, exact.score.rmse_ut, rtol=0.05)
    report = told.hyperparameters
    assert report["engine"] == "compromise"
    assert report["nodes"] > 20
    assert report["observations"] == report["observations_used"]
    assert np.all(np.array(report["rmse_against_intermediate_ut"]) < 0.15 * np.array(report["white_noise_sd_ut"]))
    assert report["node_spacing_m"] <= min(report["length_m"]) / 2


def test_more_observations_than_the_exact_engine_takes_are_thinned(walks, monkeypatch):
    monkeypatch.setattr(compromise_engine, "MAX_OBSERVATIONS", 60)
    fitted = fit_map(walks, SPEC)
    assert fitted.hyperparameters["observations_used"] == 60
    assert fitted.hyperparameters["observations"] > 100
    assert fitted.score.held_out_samples == fit_map(walks, MapSpec(resolution_m=0.5)).score.held_out_samples


def test_nodes_are_laid_farther_apart_where_there_would_be_too_many(walks, monkeypatch):
    free = fit_map(walks, SPEC).hyperparameters
    monkeypatch.setattr(compromise_engine, "MAX_NODES", 12)
    bound = fit_map(walks, SPEC).hyperparameters
    assert bound["nodes"] <= 12 < free["nodes"]
    assert bound["node_spacing_m"] > free["node_spacing_m"]
    assert max(bound["rmse_against_intermediate_ut"]) > max(free["rmse_against_intermediate_ut"])


@pytest.mark.parametrize(("components", "surveys"), [("norm", 1), ("level", 2)])
def test_other_components_and_single_surveys_are_fitted_too(make_room, components, surveys):
    room, rng = make_room(7), np.random.default_rng(1)
    few = {str(k): room.walk(rng, np.array([[0.5, 1.0 + 0.5 * k], [4.0, 1.0 + 0.5 * k]])) for k in range(surveys)}
    fitted = fit_map(few, MapSpec(engine="compromise", components=components, resolution_m=0.5))
    assert np.isfinite(fitted.grid.mean_uT).all()
    assert fitted.grid.measured.any()
    assert (fitted.score is None) == (surveys == 1)
