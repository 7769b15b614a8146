import numpy as np
import pytest

from app.field.exact import estimate_by_exact
from app.field.fit import fit_map
from app.field.hard_iron import Cleaned, HardIron
from app.field.hilbert import posterior
from app.field.hyperparameters import Hyperparameters
from app.field.leave_one_out import HeldOut, HeldOutPrediction, error_correlation_m, score
from app.field.observations import observe
from app.field.spec import MapSpec
from app.field.statistics import add_evidence, marginalise
from app.field.tile_fit import Learned, fit_tile
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Lattice

AMBIENT = np.array([18.0, 3.0, -44.0])
HYPER = Hyperparameters(
    "matern32", 1.8, np.full(3, 2.5), white_ratio=0.02, bias_ratio=0.05, walk_ratio=0.1, walk_length_m=1.5
)


LATTICES = {
    "plane": (Lattice.for_length("matern32", 1.8), HYPER),
    "slab": (Lattice.of_slabs("matern52", 1.8, (-0.5, 0.5), potential=False), HYPER),
    "potential": (Lattice.of_slabs("matern52", 1.8, (-0.5, 0.5), potential=True), HYPER),
}


@pytest.mark.parametrize("kind", LATTICES)
def test_leaving_out_by_subtraction_equals_a_refit_without_the_survey(room, kind):
    lattice, hyper = LATTICES[kind]
    learned, heights = Learned(hyper, lattice, AMBIENT, 0), np.zeros(1)
    walks = observe(room.lanes(np.random.default_rng(1), lane_m=2.0), "vector")
    left_out, others = walks[1], [walks[0], *walks[2:]]
    tiled = TiledWalks(lattice, walks, AMBIENT)
    predicted = HeldOutPrediction(lattice, walks, 3 if kind == "potential" else 1)
    for tile in tiled.counts():
        fit = fit_tile(tiled, tile, learned, 1.0, heights, robust=False)
        predicted.add(tile, tiled.all_answered(tile), fit.held_out)

    points = left_out.position_m
    mean, variance = np.zeros((len(points), 3)), np.ones((len(points), 3 if kind == "potential" else 1))
    answering, without = lattice.answering(points), TiledWalks(lattice, others, AMBIENT)
    for tile in without.counts():
        basis = lattice.basis(tile)
        surveys = without.statistics(tile, hyper.walk_noise_in(basis))
        evidence = add_evidence([marginalise(basis, name, survey, hyper) for name, survey in surveys.items()])
        inside = answering.get(tile, np.array([], dtype=int))
        at, ratio = posterior(basis, evidence, hyper).at(points[inside])
        weight = lattice.weight(0, tile, points[inside, 0]) * lattice.weight(1, tile, points[inside, 1])
        mean[inside] += weight[:, None] * at
        variance[inside] += weight[:, None] * (ratio - 1.0)
    assert np.allclose(predicted.mean_uT[left_out.survey_id], mean, atol=1e-6)
    assert np.allclose(predicted.variance_ratio[left_out.survey_id], variance, atol=1e-6)


def test_the_exact_engine_leaves_out_by_honest_refits(room):
    walks = observe(room.lanes(np.random.default_rng(1), surveys=3, lane_m=2.0), "norm")
    ambient = np.median(np.concatenate([w.field_uT for w in walks]), axis=0)
    estimate = estimate_by_exact(
        walks, Cleaned({}, HardIron(), {}), MapSpec(engine="exact", resolution_m=1.0), None, lambda f, m: None
    )
    left_out = walks[0]
    error = left_out.field_uT - ambient - estimate.held_out_mean_uT[left_out.survey_id]
    in_sample = np.std(left_out.field_uT)
    assert 0.0 < np.sqrt(np.mean(np.square(error))) < in_sample
    assert np.all(estimate.held_out_variance_ratio[left_out.survey_id] > 0.0)


def held_out(standardised, step_m=0.1):
    n = len(standardised)
    return HeldOut(standardised, np.ones_like(standardised), np.ones(n, dtype=bool), step_m * np.arange(n))


def test_score_of_calibrated_errors():
    errors = np.random.default_rng(0).normal(size=(20_000, 2))
    halves = {"a": errors[:5000], "b": errors[5000:]}
    scored = score({name: held_out(half) for name, half in halves.items()}, halves)
    assert scored.held_out_samples == 20_000
    assert scored.rmse_ut == pytest.approx((1.0, 1.0), abs=0.02)
    assert scored.coverage_2sigma == pytest.approx((0.9545, 0.9545), abs=0.005)
    assert scored.nlpd == pytest.approx(0.5 * np.log(2 * np.pi) + 0.5, abs=0.02)


def test_the_score_of_the_vector_of_the_norm_and_sharpness_by_hand():
    measured = np.array([[3.0, 4.0], [0.0, 5.0], [100.0, 100.0]])
    predicted = np.array([[6.0, 8.0], [5.0, 0.0], [0.0, 0.0]])
    judged = np.array([True, True, False])
    h = HeldOut(measured - predicted, np.array([[1.0, 2.0], [3.0, 4.0], [9.0, 9.0]]), judged, np.arange(3.0))
    scored = score({"a": h}, {"a": measured})
    assert scored.rmse_ut == pytest.approx((np.sqrt((9 + 25) / 2), np.sqrt((16 + 25) / 2)))
    assert scored.rmse_vec_ut == pytest.approx(np.hypot(*scored.rmse_ut))  # Kuevor (2.9)
    assert scored.rmse_of_norm_ut == pytest.approx(np.sqrt((25 + 0) / 2))  # a turned vector has the right norm
    assert scored.sharpness_ut == pytest.approx((2.0, 3.0))


def test_the_norm_of_a_norm_map_is_itself(room):
    fitted = fit_map(room.lanes(np.random.default_rng(1), surveys=2), MapSpec(components="norm", resolution_m=1.0))
    assert fitted.score.rmse_of_norm_ut == pytest.approx(fitted.score.rmse_ut[0])
    assert fitted.score.rmse_vec_ut == pytest.approx(fitted.score.rmse_ut[0])


def test_nothing_judged_gives_no_score():
    one = held_out(np.zeros((10, 1)))
    assert score({"a": HeldOut(one.error_uT, one.sd_uT, np.zeros(10, dtype=bool), one.path_m)}, {}) is None


@pytest.mark.parametrize("length_m", [1.0, 3.0])
def test_error_correlation_is_the_length_of_an_ornstein_uhlenbeck_error(length_m):
    rng = np.random.default_rng(0)
    rho = np.exp(-0.1 / length_m)
    walks = {}
    for walk in range(5):
        e = np.zeros((4000, 1))
        for i in range(1, len(e)):
            e[i] = rho * e[i - 1] + np.sqrt(1 - rho**2) * rng.normal()
        walks[str(walk)] = held_out(e)
    assert error_correlation_m(walks) == pytest.approx(length_m, rel=0.35)


def test_white_errors_are_uncorrelated():
    assert error_correlation_m({"a": held_out(np.random.default_rng(0).normal(size=(4000, 3)))}) < 0.3
