"""The reduced-rank process against the exact one on the same kernel and data."""

import numpy as np
import pytest

from app.field.exact import ExactProcess
from app.field.hilbert import posterior, predict
from app.field.hyperparameters import Hyperparameters
from app.field.kernels import covariance
from app.field.observations import observe
from app.field.raster import GridFrame, blend, tile_cells
from app.field.statistics import add_evidence, marginalise, survey_statistics
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Lattice

AMBIENT = np.array([18.0, 3.0, -44.0])


def fit(walks, hyper, frame, resolution_m=0.5, wide=False):
    lattice = Lattice.for_length(hyper.kernel, hyper.length_m, wide)
    tiled = TiledWalks(lattice, walks, AMBIENT)
    patches = {}
    for tile in tiled.counts():
        cells = [tile_cells(lattice, axis, tile, resolution_m) for axis in (0, 1)]
        patches[tile] = fitted_tile(tiled, tile, hyper).patch(*cells, frame.heights_m)
    return blend(lattice, frame, resolution_m, patches)


def evidence_of(tiled, tile, hyper):
    basis = tiled.lattice.basis(tile)
    surveys = tiled.statistics(tile, hyper.walk_noise_in(basis))
    return add_evidence([marginalise(basis, name, survey, hyper) for name, survey in surveys.items()])


def fitted_tile(tiled, tile, hyper):
    return posterior(tiled.lattice.basis(tile), evidence_of(tiled, tile, hyper), hyper)


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize(
    ("kernel", "length_m"), [("squared_exponential", 1.2), ("matern52", 1.8), ("matern32", 2.6), ("matern32", 2.0)]
)
def test_mean_and_sd_agree_with_the_exact_process(room, kernel, length_m, wide):
    walks = observe(room.lanes(np.random.default_rng(1), surveys=2), "vector")
    hyper = Hyperparameters(kernel, length_m, np.full(3, 2.5), white_ratio=0.01)
    frame = GridFrame(np.arange(0.5, room.width_m - 0.25, 0.5), np.arange(0.5, room.depth_m - 0.25, 0.5), np.zeros(1))
    blended = fit(walks, hyper, frame, wide=wide)

    position = np.concatenate([walk.position_m for walk in walks])
    target = np.concatenate([walk.field_uT for walk in walks]) - AMBIENT
    x, y = np.meshgrid(frame.x_m, frame.y_m)
    centres = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    process = ExactProcess(kernel, length_m, 2.5, 0.25)
    for c in range(3):
        mean, variance = process.condition(position, target[:, c]).at(centres)
        field_sd = np.std(room.field_uT(centres)[:, c])
        assert np.sqrt(np.mean(np.square(blended.mean_uT[c].ravel() - mean))) < 0.02 * field_sd
    assert np.sqrt(np.mean(np.square(np.sqrt(blended.variance_ratio.ravel() / variance) - 1.0))) < 0.05


def test_the_gradient_is_the_derivative_of_the_blended_mean(room):
    walks = observe(room.lanes(np.random.default_rng(1), surveys=2), "vector")
    hyper = Hyperparameters("matern32", 1.0, np.full(3, 2.5), white_ratio=0.01, bias_ratio=0.01)
    h = 0.004
    frame = GridFrame(h * np.arange(250, 900), h * np.arange(900, 1300), np.zeros(1))
    blended = fit(walks, hyper, frame, h)
    mean, slopes = blended.mean_uT[:, 0], blended.gradient_uT_per_m[:, :, 0]
    by_x = (mean[:, :, 2:] - mean[:, :, :-2]) / (2 * h)
    by_y = (mean[:, 2:] - mean[:, :-2]) / (2 * h)
    assert np.allclose(slopes[0][:, :, 1:-1], by_x, atol=5e-3)
    assert np.allclose(slopes[1][:, 1:-1], by_y, atol=5e-3)


def test_far_from_samples_the_prior_returns(room):
    walks = observe(room.lanes(np.random.default_rng(1), surveys=2), "vector")
    hyper = Hyperparameters("matern32", 1.0, np.full(3, 2.5), white_ratio=0.01)
    blended = fit(walks, hyper, GridFrame(np.array([60.0, 60.5]), np.array([60.0]), np.zeros(1)))
    assert np.all(blended.mean_uT == 0.0)
    assert np.all(blended.variance_ratio == 1.0)


def test_predicting_a_few_points_equals_the_posterior_there(room):
    walks = observe(room.lanes(np.random.default_rng(1), surveys=2), "vector")
    hyper = Hyperparameters("matern32", 1.5, np.full(3, 2.5), white_ratio=0.05, bias_ratio=0.01)
    tiled = TiledWalks(Lattice.for_length("matern32", 1.5), walks, AMBIENT)
    tile = list(tiled.counts())[4]
    basis, evidence = tiled.lattice.basis(tile), evidence_of(tiled, tile, hyper)
    points = np.random.default_rng(0).uniform(basis.corner_m, np.array(basis.corner_m) + basis.side_m, (20, 2))
    for one, other in zip(
        predict(basis, evidence, hyper, points), posterior(basis, evidence, hyper).at(points), strict=True
    ):
        assert np.allclose(one, other, atol=1e-9)
    x_m, y_m = points[:5, 0], points[:6, 1]
    few, many = (posterior(basis, evidence, hyper, asked) for asked in (30, 10_000))
    for one, other in zip(few.patch(x_m, y_m, np.zeros(1))[:3], many.patch(x_m, y_m, np.zeros(1))[:3], strict=True):
        assert np.allclose(one, other, atol=1e-9)
    assert np.allclose(few.at(points)[1], many.at(points)[1], atol=1e-9)


def test_coverage_is_honest_on_data_from_the_model():
    rng = np.random.default_rng(5)
    lattice = Lattice(6.0)
    hyper = Hyperparameters("matern32", 1.8, np.full(1, 3.0), white_ratio=0.02)
    tile = next(iter(lattice.fitting(np.array([[3.0, 3.0]]))))
    basis = lattice.basis(tile)
    points = rng.uniform(basis.corner_m, np.array(basis.corner_m) + basis.side_m, (500, 2))
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    root = np.linalg.cholesky(covariance("matern32", distance, 1.8) + 1e-9 * np.eye(500))
    inside = []
    for _ in range(12):
        f = 3.0 * root @ rng.normal(size=(500, 1))
        y = f[:250] + 3.0 * np.sqrt(0.02) * rng.normal(size=(250, 1))
        from_half = posterior_from(basis, points[:250], y, hyper)
        mean, variance = from_half.at(points[250:])
        inside.append(np.abs(mean - f[250:]) <= 2.0 * 3.0 * np.sqrt(variance))
    assert 0.93 < np.mean(inside) < 0.975


def posterior_from(basis, points, y, hyper):
    statistics = survey_statistics(basis, points, y, np.arange(float(len(points))), hyper.walk_noise_in(basis))
    return posterior(basis, marginalise(basis, "", statistics, hyper), hyper)
