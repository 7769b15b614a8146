"""Positions as pictures: where a likelihood lies on a layer, and how large an ellipse is."""

import numpy as np
import pytest

from app.viewer.asked import Ellipse, Likelihood
from app.viewer.layers import ColourScale, layer_values
from app.viewer.marks import blend_likelihood, ellipse_points_m, likelihood_legend
from app.viewer.scene import surface


def likelihood_at(origin_m, nats):
    return Likelihood(floor_id="a", height_m=1.2, origin_m=origin_m, resolution_m=1.0, log_likelihood=nats)


def test_a_likelihood_is_bright_where_it_is_and_leaves_the_rest(grid_of):
    grid, origin = grid_of(), np.array([112.0, 47.0, 0.0])
    picture = surface(grid, layer_values(grid, "norm"), ColourScale(20.0, 80.0), origin)
    before = picture.rgba.copy()
    nats = np.full((14, 24), None, dtype=object)  # a metre a cell, centred on half metres from the map's corner
    nats[3, 5] = 0.0
    nats[3, 6] = -5.0
    blend_likelihood(picture, likelihood_at([100.5, 40.5], nats.tolist()), origin)
    changed = (picture.rgba != before).any(axis=-1)
    j, i = np.nonzero(changed)
    x, y = 100.0 + 0.25 * i, 40.0 + 0.25 * j
    assert (x.min(), x.max()) == pytest.approx((105.0, 107.0), abs=0.3)
    assert (y.min(), y.max()) == pytest.approx((43.0, 44.0), abs=0.3)
    best = picture.rgba[14, 22]  # x = 105.5, y = 43.5
    np.testing.assert_array_equal(best, [*ColourScale(-20.0, 0.0, "inferno").rgb(np.array(0.0)), 255])
    np.testing.assert_array_equal(picture.rgba[~changed], before[~changed])


def test_a_likelihood_beside_the_map_changes_nothing(grid_of):
    grid, origin = grid_of(), np.zeros(3)
    picture = surface(grid, layer_values(grid, "norm"), ColourScale(20.0, 80.0), origin)
    before = picture.rgba.copy()
    blend_likelihood(picture, likelihood_at([500.0, 500.0], [[0.0]]), origin)
    np.testing.assert_array_equal(picture.rgba, before)


def test_the_ellipse_holds_95_percent_of_the_belief():
    covariance = np.array([[2.0, 0.8], [0.8, 0.5]])
    ellipse = Ellipse(floor_id="a", position_m=[3.0, -1.0, 0.0], covariance_m2=covariance.tolist())
    line = ellipse_points_m(ellipse) - [3.0, -1.0]
    distance = np.einsum("ni,ij,nj->n", line, np.linalg.inv(covariance), line)
    np.testing.assert_allclose(distance, distance[0])
    drawn = np.random.default_rng(1).multivariate_normal([0, 0], covariance, size=200_000)
    inside = np.einsum("ni,ij,nj->n", drawn, np.linalg.inv(covariance), drawn) <= distance[0]
    assert inside.mean() == pytest.approx(0.95, abs=0.002)


def test_the_likelihoods_legend_says_what_it_is():
    told = likelihood_legend()
    assert told.unit == "nats"
    assert told.ticks[0] == "-20.0"
    assert told.ticks[-1] == "0.0"
