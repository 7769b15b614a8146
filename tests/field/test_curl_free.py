"""Maps that are the gradient of a potential, on the analytic building."""

from dataclasses import replace

import numpy as np
import pytest

from app.errors import InvalidInput
from app.field.fit import fit_map
from app.field.samples import Samples
from app.field.spec import MapSpec
from app.synthetic.building import make_building

NOISE_UT = 0.4


@pytest.fixture(scope="module")
def building():
    return make_building(np.random.default_rng(3), width_m=12.0, depth_m=11.0, floors=1)


def lanes(building, rng, height_m, offset_m, across=False, lane_m=1.0):
    """A lawnmower walk along x, or across."""
    low, high = np.array(building.walkable_m).reshape(2, 2)[:, :: -1 if across else 1]
    rows = []
    for k, v in enumerate(np.arange(low[1] + offset_m, high[1], lane_m)):
        u = np.arange(low[0], high[0], 0.2)
        rows.append(np.column_stack([u if k % 2 == 0 else u[::-1], np.full(len(u), v)]))
    flat = np.concatenate(rows)[:, :: -1 if across else 1]
    p = np.column_stack([flat, np.full(len(flat), height_m)])
    return Samples(0.2 * np.arange(len(p)), p, building.field_uT(p) + NOISE_UT * rng.normal(size=p.shape), "building")


def inner(building, height_m):
    x0, y0, x1, y1 = building.walkable_m
    x, y = np.meshgrid(np.arange(x0 + 1.0, x1 - 1.0, 0.3), np.arange(y0 + 1.0, y1 - 1.0, 0.3))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height_m)])


def rmse(fitted, building, height_m):
    p = inner(building, height_m)
    return float(np.sqrt(np.mean(np.square(fitted.grid.at(p).mean_uT - building.field_uT(p)))))


def test_at_one_height_it_is_better_and_has_no_curl_anywhere(building):
    rng = np.random.default_rng(1)
    walks = {str(across): lanes(building, rng, 1.2, 0.3, across, 1.5) for across in (False, True)}
    free, independent = (fit_map(walks, MapSpec(curl_free=free, resolution_m=0.25)) for free in (True, False))
    assert rmse(free, building, 1.2) < 0.95 * rmse(independent, building, 1.2)
    slopes = free.grid.gradient_uT_per_m  # (nz, ny, nx, component, direction)
    assert np.array_equal(slopes, np.swapaxes(slopes, -1, -2))
    mean, h = free.grid.mean_uT[0].astype(float), free.grid.resolution_m
    inside = free.grid.measured[0, 1:-1, 1:-1]
    curl = (mean[1:-1, 2:, 1] - mean[1:-1, :-2, 1] - mean[2:, 1:-1, 0] + mean[:-2, 1:-1, 0]) / (2 * h)
    steep = np.linalg.norm(slopes[0, 1:-1, 1:-1], axis=(-2, -1))
    assert np.sqrt(np.mean(curl[inside] ** 2)) < 0.05 * np.sqrt(np.mean(steep[inside] ** 2))  # of differences
    p = inner(building, 1.2)
    values = free.grid.at(p)
    assert np.mean(np.abs(values.mean_uT - building.field_uT(p)) <= 2 * values.sd_uT) > 0.9


def test_a_height_nobody_walked_is_predicted_twice_as_well(building):
    rng = np.random.default_rng(1)
    walks = {f"{z}-{across}": lanes(building, rng, z, 0.3, across) for z in (0.8, 1.6) for across in (False, True)}
    heights = (0.8, 1.2, 1.6)
    free, independent = (
        fit_map(walks, MapSpec(curl_free=free, resolution_m=0.5, heights_m=heights, noise="white"))
        for free in (True, False)
    )
    assert free.grid.heights_m.tolist() == list(heights)
    assert free.grid.gradient_uT_per_m.shape[-1] == 3
    assert rmse(free, building, 1.2) < 0.5 * rmse(independent, building, 1.2)
    assert free.score is not None


def covered(fitted, building, height_m):
    p = inner(building, height_m)
    values = fitted.grid.at(p)
    return float(
        np.mean(np.abs(values.mean_uT - building.field_uT(p))[values.measured] <= 2 * values.sd_uT[values.measured])
    )


@pytest.fixture(scope="module")
def at_one_height(building):
    rng = np.random.default_rng(1)
    return {str(across): lanes(building, rng, 1.2, 0.3, across, 1.5) for across in (False, True)}


@pytest.fixture(scope="module")
def plain(at_one_height):
    return fit_map(at_one_height, MapSpec(curl_free=True, noise="white"))


def test_layers_asked_for_do_not_change_what_is_learned(building, at_one_height, plain):
    spec = MapSpec(curl_free=True, noise="white", heights_m=(0.2, 1.2, 1.6, 900.0))
    layered = fit_map(at_one_height, spec)
    assert layered.hyperparameters == plain.hyperparameters
    assert rmse(layered, building, 1.2) == pytest.approx(rmse(plain, building, 1.2), rel=0.1)
    assert layered.grid.measured.any(axis=(1, 2)).tolist() == [False, True, True, False]
    assert covered(layered, building, 1.6) > 0.9
    unmeasured = layered.grid.sd_uT[[0, 3]]
    assert np.allclose(unmeasured, layered.grid.prior_sd_uT)
    assert np.all(np.isfinite(unmeasured))


@pytest.mark.parametrize("kernel", ["matern32", "matern52"])
def test_rougher_kernels_are_about_as_good(building, at_one_height, plain, kernel):
    rough = fit_map(at_one_height, MapSpec(curl_free=True, noise="white", kernel=kernel))
    assert rmse(rough, building, 1.2) < 1.3 * rmse(plain, building, 1.2)
    assert 0.88 < covered(rough, building, 1.2) < 0.995


@pytest.mark.slow
def test_a_field_longer_than_the_boxes_is_not_taken_for_offsets(building):
    """A quarter of a survey's readings are its own constant: the others still tell the field."""
    rng, walks = np.random.default_rng(5), {}
    for k in range(4):
        one = lanes(building, rng, 1.2, 0.3 + 0.4 * (k % 2), k > 1)
        walks[str(k)] = Samples(one.t_s, one.p_building_m, one.B_uT + rng.normal(0.0, 1.0, 3), "building")
    fitted = fit_map(walks, MapSpec(curl_free=True))
    assert covered(fitted, building, 1.2) > 0.85


@pytest.mark.slow
def test_a_constant_field_is_a_map(at_one_height):
    B_uT = np.array([18.0, 3.0, -42.0])
    walks = {
        name: Samples(w.t_s, w.p_building_m, np.tile(B_uT, (len(w.t_s), 1)), "building")
        for name, w in at_one_height.items()
    }
    grid = fit_map(walks, MapSpec(curl_free=True, noise="white")).grid
    assert grid.measured.any()
    assert np.allclose(grid.mean_uT, B_uT, atol=1e-3)
    assert grid.sd_uT.max() < 0.01


def test_labels_of_a_curl_free_map_can_be_refined(at_one_height):
    fitted = fit_map(at_one_height, MapSpec(curl_free=True, refine=True, noise="white", resolution_m=0.5))
    assert "recovered_share" in fitted.hyperparameters["refinement"]


def test_what_makes_no_map_is_refused(at_one_height):
    with pytest.raises(InvalidInput, match=r"between 1.20 and 1.20 m.*\(900 m\)"):
        fit_map(at_one_height, MapSpec(curl_free=True, heights_m=(900.0,)))
    with pytest.raises(InvalidInput, match="ask for kernel matern32"):
        fit_map(at_one_height, MapSpec(curl_free=True, kernel="matern32+matern32"))
    tall = {}
    for name, walk in at_one_height.items():
        rising_m = walk.p_building_m.copy()
        rising_m[:, 2] = np.linspace(0.0, 60.0, len(rising_m))
        tall[name] = replace(walk, p_building_m=rising_m)
    with pytest.raises(InvalidInput, match="one map of each level"):
        fit_map(tall, MapSpec(curl_free=True))


def test_a_plane_holds_for_heights_near_its_surveys_only(at_one_height):
    grid = fit_map(at_one_height, MapSpec(noise="white", resolution_m=0.5, heights_m=(1.2,))).grid
    assert grid.measured.any()
    with pytest.raises(InvalidInput, match="no layer of heights_m"):
        fit_map(at_one_height, MapSpec(heights_m=(100000.0,)))


def test_variances_of_close_layers_are_those_of_single_ones(at_one_height):
    close = tuple(np.linspace(0.8, 1.6, 17).round(2).tolist())
    many = fit_map(at_one_height, MapSpec(curl_free=True, noise="white", resolution_m=0.5, heights_m=close)).grid
    few = fit_map(
        at_one_height, MapSpec(curl_free=True, noise="white", resolution_m=0.5, heights_m=(0.8, 1.15, 1.6))
    ).grid
    assert np.allclose(many.mean_uT[[0, 7, 16]], few.mean_uT, atol=1e-4)
    ratio = (many.sd_uT[[0, 7, 16]] / few.sd_uT)[few.measured]
    assert np.abs(np.median(ratio) - 1.0) < 0.05
    assert np.quantile(ratio, [0.05, 0.95]) == pytest.approx(1.0, abs=0.25)
