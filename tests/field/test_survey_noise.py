"""Single surveys that err more than the others: found, and kept from spoiling the map."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from app.field.basis import CosineBasis
from app.field.fit import fit_map
from app.field.kernels import spectral_density
from app.field.marginal_likelihood import TileStatistics, negative_log_likelihood
from app.field.spec import MapSpec
from app.field.statistics import survey_statistics
from app.field.survey_noise import CLEAR, clearly_differ, noise_scales
from app.field.walk_noise import WalkNoise
from tests.field.test_incremental import refit, same_map

SPEC = MapSpec(resolution_m=0.5)


def rmse_uT(fitted, room):
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(1.0, 11.0, 0.5), np.arange(1.0, 8.0, 0.5)))
    points = np.column_stack([x, y, np.zeros(len(x))])
    return np.sqrt(np.mean(np.square(fitted.grid.at(points).mean_uT - room.field_uT(points))))


def in_wrong_unit(walk):
    return replace(walk, B_uT=0.1 * walk.B_uT)


def with_an_offset(walk):
    return replace(walk, B_uT=walk.B_uT + np.array([20.0, 0.0, 0.0]))


def with_axes_swapped(walk):
    return replace(walk, B_uT=walk.B_uT[:, [1, 0, 2]])


def noisy(walk):
    return replace(walk, B_uT=walk.B_uT + np.random.default_rng(3).normal(0.0, 6.0, walk.B_uT.shape))


@pytest.mark.parametrize("spoil", [in_wrong_unit, with_an_offset, with_axes_swapped, noisy])
def test_a_map_with_a_bad_survey_is_about_as_good_as_without_it(make_room, spoil):
    room = make_room(11)
    walks = room.lanes(np.random.default_rng(1), surveys=5, lane_m=1.5)
    bad = walks | {"survey-4": spoil(walks["survey-4"])}
    del walks["survey-4"]
    fitted = fit_map(bad, SPEC)
    assert rmse_uT(fitted, room) < 1.3 * rmse_uT(fit_map(walks, SPEC), room)
    scales = fitted.hyperparameters["survey_noise_scale"]
    assert scales["survey-4"] > 20.0
    assert all(abs(np.log(scales.get(name, 1.0))) < CLEAR for name in walks)
    assert fitted.consistency["survey-4"].status == "inconsistent"


def test_surveys_alike_share_one_noise_and_are_learned_from_once(make_room):
    walks = make_room(11).lanes(np.random.default_rng(1), surveys=5, lane_m=1.5)
    assert "survey_noise_scale" not in fit_map(walks, SPEC).hyperparameters


def test_a_bad_survey_that_comes_later_costs_its_tiles_and_leaves_with_them(make_room):
    room, rng = make_room(11), np.random.default_rng(1)
    walks = room.lanes(rng, surveys=4, lane_m=2.0)
    first = fit_map(walks, SPEC)
    extra = with_an_offset(room.walk(rng, np.array([[1.0, 1.0], [4.0, 1.5], [4.0, 3.5], [1.0, 3.0]])))
    added = fit_map(walks | {"extra": extra}, SPEC, previous=first.state)
    assert added.hyperparameters["survey_noise_scale"]["extra"] > 5.0
    assert added.tiles_refitted < len(added.state.tiles)
    same_map(added, refit(walks | {"extra": extra}, SPEC, first.state))
    same_map(added, refit(walks | {"extra": extra}, SPEC, added.state))
    same_map(fit_map(walks, SPEC, previous=added.state), first)


def test_scaled_statistics_are_those_of_larger_errors():
    """Against the dense covariance: all errors of the second walk, its offset too, have seven times the variance."""
    rng, basis, noise, factor = np.random.default_rng(0), CosineBasis((0.0, 0.0), 6.0, 7), WalkNoise(2.0, 1.5), 7.0
    length, white, bias = 1.8, 0.05, 0.02
    path = np.linspace(0.0, 6.0, 25)
    points, y = rng.uniform(0.0, 6.0, (2, 25, 2)), rng.normal(0.0, 2.0, (2, 25, 1))
    surveys = [survey_statistics(basis, points[k], y[k], path, noise) for k in (0, 1)]
    tile = TileStatistics.of(basis, [surveys[0], surveys[1].scaled(factor)])
    likelihood = negative_log_likelihood([tile], "matern32", np.log([length, white, bias]))
    phi = basis.at(points.reshape(-1, 2))
    dense = (phi * spectral_density("matern32", basis.frequencies_squared, length)) @ phi.T
    errors = white * (np.eye(25) + 2.0 * np.exp(-np.abs(path[:, None] - path) / 1.5)) + bias
    dense[:25, :25] += errors
    dense[25:, 25:] += factor * errors
    naive = -multivariate_normal(cov=likelihood.signal_variance_uT2[0] * dense).logpdf(y.ravel())
    assert likelihood.value == pytest.approx(naive, rel=1e-5)


def test_only_clear_differences_count():
    rng = np.random.default_rng(0)
    freedom = {f"s{k}": 40.0 for k in range(8)}
    alike = {name: float(rng.chisquare(40.0)) / 40.0 for name in freedom}
    assert set(noise_scales(alike, freedom).values()) == {1.0}
    found = noise_scales(alike | {"s3": 30.0}, freedom)
    assert found["s3"] == pytest.approx(30.0, rel=0.5)
    assert clearly_differ({}, found)
    assert not clearly_differ(found, found)


def test_of_two_surveys_nobody_knows_which_is_wrong():
    assert noise_scales({"a": 1.0, "b": 50.0}, {"a": 40.0, "b": 40.0}) == {}
    assert noise_scales({"a": 1.0, "b": 50.0, "c": 1.0}, {"a": 40.0, "b": 40.0, "c": 0.2}) == {}
