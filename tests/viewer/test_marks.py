"""Positions as pictures: where a likelihood lies on a layer, and how large an ellipse is."""

import numpy as np
import pytest

from app.viewer.asked import Ellipse, Likelihood, Marks, Mode, Path
from app.viewer.layers import ColourScale, layer_values
from app.viewer.mark_nodes import Ball, Line, MarkNodes, Words
from app.viewer.marks import blend_likelihood, ellipse_points_m, likelihood_legend, mark_pieces
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


def test_what_concerns_a_floor_is_named_by_what_it_is():
    here = {"floor_id": "a", "position_m": [3.0, -1.0, 0.0]}
    modes = [Mode(**here, probability=1.0, heading_rad=0.0, label="phone"), Mode(**here, probability=0.25),
             Mode(**here | {"floor_id": "b"}, probability=0.5)]  # fmt: skip
    path = Path(floor_id="a", kind="estimate", points_m=[[0, 0, 0], [1, 0, 0]])
    alone = Path(floor_id="a", kind="estimate", points_m=[[0, 0, 0]])
    marks = Marks(modes=modes, paths=[path, alone], ellipses=[Ellipse(**here, covariance_m2=[[1, 0], [0, 1]])])
    pieces = mark_pieces("a", 1.0, marks, np.array([3.0, 0.0, 0.0]))
    assert list(pieces) == ["path 0", "ellipse 0", "mode 0", "mode 0/share", "mode 0 heading", "mode 1", "mode 1/share"]
    assert pieces["mode 0"].at_m == pytest.approx((0.0, -1.0, 1.16))
    assert pieces["mode 0 heading"].points_m[1] == pytest.approx((1.0, -1.0, 1.16))
    assert (pieces["mode 0/share"].text, pieces["mode 1/share"].text) == ("phone", "25 %")
    assert mark_pieces("c", 1.0, marks, np.zeros(3)) == {}


class Handle:
    def __init__(self, scene, name, position=None):
        self.__dict__.update(scene=scene, name=name)
        scene.sent.append(("add", name))

    def __setattr__(self, what, value):
        self.scene.sent.append(("move", self.name))

    def remove(self):
        self.scene.sent.append(("remove", self.name))


class Scene:
    """Writes down what it is asked for."""

    def __init__(self):
        self.sent = []

    def add_frame(self, name, *_, **more):
        return Handle(self, name)

    add_icosphere = add_label = add_frame

    def add_line_segments(self, name, points, colours, **_):
        return Handle(self, name)

    def told(self):
        told, self.sent = self.sent, []
        return told


def test_of_marks_only_what_changed_is_sent():
    scene = Scene()
    nodes = MarkNodes(scene, "/floor 0/tracks")
    red, line = (255, 0, 0), Line(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), (255, 0, 0), 2.0)
    first = {"line": line, "ball": Ball((0.0, 0.0, 0.0), red, 0.4), "ball/share": Words((0.0, 0.0, 0.5), "phone")}
    nodes.draw(first)
    assert scene.told() == [("add", f"/floor 0/tracks{name}") for name in ("", "/line", "/ball", "/ball/share")]
    nodes.draw(dict(first))
    assert scene.told() == []
    nodes.draw(first | {"ball": Ball((1.0, 0.0, 0.0), red, 0.4)})
    assert scene.told() == [("move", "/floor 0/tracks/ball")], "and its label with it"
    longer = Line((*line.points_m, (2.0, 0.0, 0.0)), red, 2.0)
    nodes.draw(first | {"line": longer, "ball": Ball((1.0, 0.0, 0.0), red, 0.4)})
    assert scene.told() == [("add", "/floor 0/tracks/line")], "in place, without being taken away"
    nodes.draw({})
    assert scene.told() == [("remove", f"/floor 0/tracks/{name}") for name in ("line", "ball/share", "ball")]
