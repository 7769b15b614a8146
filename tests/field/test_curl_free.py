"""Maps that are the gradient of a potential, on the analytic building."""

import numpy as np
import pytest

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
