"""What a page asks its scene for, over HTTP, and what viser's client is then sent."""

import io
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from app.viewer.layers import layer_names
from app.viewer.page import ViewerApp
from app.viewer.source import PlacedPlan


@pytest.fixture
def looking(running, open_page):
    """A signed-in page with its canvas connected: `ask` and the messages its canvas gets."""
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        page = open_page(socket)

        class Looking:
            canvas = page

            @staticmethod
            def ask(what, **asked):
                return running.ask(cookie, what, **asked)

        yield Looking


def test_a_page_is_shown_every_floor_of_the_first_building(looking):
    told = looking.ask("show").json()
    assert told["building_id"] == "tower"
    assert told["floor_id"] is None
    assert [f["name"] for f in told["floors"]] == ["Ground", "First", "Roof"]
    assert [f["map_id"] for f in told["floors"]] == ["map-0", "map-1", None]
    assert told["floors"][0]["measured_m2"] == pytest.approx(213, abs=1)
    assert told["notes"] == []
    looking.canvas.read_until(lambda p: len(p.labels()) == 3 and p.of_type("ArrowMessage"))
    assert looking.canvas.labels() == ["Ground", "First", "Roof: no map yet"]
    assert len(looking.canvas.of_type("ImageMessage")) == 2
    assert len(looking.canvas.of_type("SetCameraPositionMessage")) == 1


def test_every_layer_is_offered_and_drawn(looking, source):
    told = looking.ask("show", floor_id="floor-0").json()
    names = [layer["name"] for layer in told["layers"]]
    assert set(names) == set(layer_names("vector", {"coverage"})) - {"measured"}
    assert all(layer["title"] and layer["about"] for layer in told["layers"])
    for drawn, name in enumerate(names, start=1):
        told = looking.ask("show", floor_id="floor-0", layer=name).json()
        assert told["layer"] == name
        assert len(told["legend"]["ticks"]) == 5
        assert told["legend"]["unit"] == next(layer["unit"] for layer in told["layers"] if layer["name"] == name)
        looking.canvas.read_until(lambda p, n=drawn: len(p.of_type("ImageMessage")) == n)
    assert "difference" not in names
    told = looking.ask("show", floor_id="floor-0", versus_id="map-0-older", layer="difference").json()
    assert told["layer"] == "difference"
    expected = np.linalg.norm(source.grids["map-0"].mean_uT - source.grids["map-0-older"].mean_uT, axis=-1)
    measured = source.grids["map-0"].measured
    assert told["floors"][0]["median"] == pytest.approx(np.median(expected[measured]), rel=1e-3)


def test_an_older_map_is_shown_when_asked_for(looking):
    assert looking.ask("show", floor_id="floor-0", map_id="map-0-older").json()["map_id"] == "map-0-older"
    for foreign in ("map-1", "map-s", "nonsense"):  # another floor's, another organisation's, nobody's
        told = looking.ask("show", floor_id="floor-0", map_id=foreign, versus_id=foreign).json()
        assert told["map_id"] == "map-0"
        assert len(told["notes"]) == 2


@pytest.mark.parametrize("asked", [{"floor_id": "floor-s"}, {"building_id": "shed"}, {"floor_id": "no-such"}])
def test_a_foreign_deep_link_shows_ones_own_building_and_says_so(looking, running, asked):
    told = looking.ask("show", **asked).json()
    assert told["building_id"] == "tower"
    assert "not your organisation's" in told["notes"][0]
    looking.canvas.read_until(lambda p: p.labels())
    assert "hed" not in repr(looking.canvas.messages)
    assert all(organisation == "north" for organisation, _ in running.viewer.pool._source.asked)


@pytest.mark.parametrize(
    ("what", "asked", "where"),
    [
        ("show", {"layer": "no-such"}, "no layer 'no-such'"),
        ("show", {"layer": 7}, "string"),
        ("show", {"separation_m": -1}, "greater"),
        ("show", {"height_m": 1e300}, "less"),
        ("show", {"colour": "red"}, "Extra"),
        ("show", {"camera": {"position_m": [1, 2], "look_at_m": [0, 0, 0]}}, "at least 3"),
        ("pick", {"u": 2, "v": 0}, "less"),
        ("pick", {}, "required"),
        ("mark", {"modes": [{}]}, "required"),
        ("mark", {"likelihood": {"floor_id": "a", "height_m": 1, "origin_m": [0, 0], "resolution_m": 1,
                                 "log_likelihood": [[0.0], [0.0, 1.0]]}}, "equally long"),
    ],
)  # fmt: skip
def test_what_cannot_be_drawn_is_refused_with_a_reason(looking, what, asked, where):
    answer = looking.ask(what, **asked)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert where in answer.text


def test_what_is_picked_is_what_the_map_says(looking, source):
    """The canvas says its camera stands 20 m over a place and looks straight down: what is in its middle is known."""
    looking.ask("show", floor_id="floor-0", layer="gradient")
    origin = np.array([112.0, 47.0, 0.0])
    place = np.array([105.3, 42.2])
    x, y = (place - origin[:2]).tolist()
    camera = dict(type(looking.canvas).CAMERA, position=[x, y, 20.0], look_at=[x, y, 0.0], wxyz=[0.0, 1.0, 0.0, 0.0])
    looking.canvas.send(camera)
    looking.canvas.read_for(0.3)
    told = looking.ask("pick", u=0.5, v=0.5, surveys=True).json()
    at = source.grids["map-0"].at(np.array([[*place, 1.2]]))
    assert told["floor_id"] == "floor-0"
    assert told["point_m"] == pytest.approx([*place, 1.2], abs=1e-9)
    assert told["measured"] is True
    assert told["mean_ut"] == pytest.approx(at.mean_uT[0].tolist())
    assert told["sd_ut"] == pytest.approx(at.sd_uT[0].tolist())
    assert told["norm_ut"] == pytest.approx(np.linalg.norm(at.mean_uT[0]))
    assert told["layer"] == "gradient"
    assert told["layer_value"] > 0
    (lobby,) = (s for s in told["surveys"] if s["name"] == "lobby")
    assert lobby["residual_ut"] == pytest.approx([0.5, 0.0, 0.0], abs=1e-6)
    right = looking.ask("pick", u=0.75, v=0.5).json()  # a camera looking down with x to its right
    assert right["point_m"][1] == pytest.approx(place[1])
    assert right["point_m"][0] > place[0]
    assert right["surveys"] is None
    looking.canvas.send(dict(camera, position=[x, y + 500.0, 20.0]))
    looking.canvas.read_for(0.3)
    assert looking.ask("pick", u=0.5, v=0.5).status_code == 204  # no floor there


def test_positions_are_marked_on_their_floor_and_taken_away(looking):
    looking.ask("show", floor_id="floor-0")
    looking.canvas.read_until(lambda p: p.of_type("ArrowMessage"))
    likelihood = {"floor_id": "floor-0", "height_m": 1.2, "origin_m": [100.0, 40.0], "resolution_m": 1.0,
                  "log_likelihood": [[-30.0, None, 0.0]] * 4}  # fmt: skip
    place = {"floor_id": "floor-0", "position_m": [102.0, 41.0, 1.2]}
    path = {"floor_id": "floor-0", "kind": "truth", "points_m": [[100, 40, 1], [103, 40, 1]]}
    answer = looking.ask(
        "mark", likelihood=likelihood, modes=[place | {"probability": 0.75, "heading_rad": 1.0}],
        ellipses=[place | {"covariance_m2": [[0.5, 0.1], [0.1, 0.2]]}], paths=[path],
    )  # fmt: skip
    assert answer.json()["likelihood_legend"]["unit"] == "nats"
    looking.canvas.read_until(lambda p: "75 %" in p.labels())
    names = {m["name"] for m in looking.canvas.messages if "name" in m}
    assert {"/floor 0/marks/path 0", "/floor 0/marks/ellipse 0", "/floor 0/marks/mode 0"} <= names
    elsewhere = looking.ask("mark", modes=[{"floor_id": "floor-s", "position_m": [0, 0, 0], "probability": 0.31}])
    assert elsewhere.json()["likelihood_legend"] is None
    looking.canvas.read_until(lambda p: len(p.of_type("RemoveSceneNodeMessage")) >= 5)
    looking.canvas.read_for(0.3)
    gone = {m["name"] for m in looking.canvas.of_type("RemoveSceneNodeMessage")}
    assert {"/floor 0/marks/path 0", "/floor 0/marks/ellipse 0", "/floor 0/marks/mode 0"} <= gone
    assert "31 %" not in looking.canvas.labels()


def test_tracks_and_an_answer_do_not_disturb_each_other(looking):
    looking.ask("show", floor_id="floor-0")
    place = {"floor_id": "floor-0", "position_m": [102.0, 41.0, 1.2], "probability": 1.0}
    looking.ask("mark", modes=[place])
    looking.ask("mark", of="tracks", modes=[place | {"label": "phone 3"}])
    looking.ask("mark", of="tracks", modes=[place | {"label": "phone 3", "position_m": [103.0, 41.0, 1.2]}])
    looking.canvas.read_until(lambda p: "phone 3" in p.labels())
    looking.canvas.read_for(0.3)
    assert looking.canvas.labels().count("phone 3") == 1, "it is moved, not drawn anew"
    looking.ask("mark", of="tracks")
    looking.canvas.read_until(lambda p: p.of_type("RemoveSceneNodeMessage"))
    looking.canvas.read_for(0.3)
    gone = {m["name"] for m in looking.canvas.of_type("RemoveSceneNodeMessage")}
    assert "/floor 0/tracks/mode 0" in gone
    assert not any("/marks" in name for name in gone)


def test_the_nearer_the_camera_the_closer_the_arrows(looking):
    looking.ask("show", floor_id="floor-0")
    canvas = looking.canvas

    def arrows_at(distance_m):
        """Metres between arrows (their shafts tell), and how many there are."""
        canvas.messages.clear()
        canvas.send(dict(type(canvas).CAMERA, position=[0.0, -0.1, distance_m], look_at=[-5.0, -5.0, 1.2]))
        canvas.read_until(lambda p: p.of_type("ArrowMessage"))
        canvas.read_for(0.5)  # arrows that were on their way for the place before may come first
        count = looking.ask("show", floor_id="floor-0").json()["arrows"]
        return canvas.of_type("ArrowMessage")[-1]["props"]["shaft_radius"] / 0.04, count

    far_m, few = arrows_at(60.0)
    near_m, many = arrows_at(8.0)
    assert near_m <= far_m / 4
    assert few < many <= 20_000


def test_the_camera_is_told_in_building_metres_and_taken_from_a_link(looking):
    pose = {"position_m": [110.0, 30.0, 25.0], "look_at_m": [112.0, 47.0, 1.0]}
    looking.ask("show", floor_id="floor-0", camera=pose)
    looking.canvas.read_until(lambda p: p.of_type("SetCameraPositionMessage"))
    (message,) = looking.canvas.of_type("SetCameraPositionMessage")
    assert message["position"] == pytest.approx([-2.0, -17.0, 25.0])


def test_a_height_and_a_separation_are_drawn_as_asked(looking, source, grid_of):
    source.grids["map-0"] = grid_of(heights=3)
    told = looking.ask("show", floor_id="floor-0", height_m=1.8).json()
    assert told["heights_m"] == [1.2, 1.7, 2.2]
    assert told["height_m"] == 1.7
    told = looking.ask("show", building_id="tower", separation_m=7.5).json()
    assert told["separation_m"] == 7.5
    looking.canvas.read_until(lambda p: len(p.labels()) >= 3)
    looking.canvas.read_for(0.3)
    lifts = [m["position"][2] for m in looking.canvas.of_type("SetPositionMessage") if m["name"] == "/floor 2"]
    assert lifts[-1] == 15.0


def test_a_view_belongs_to_its_session(serve, keys, source, open_page):
    running = serve(ViewerApp(keys, source, connect_seconds=0.3))
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        open_page(socket)
        while running.ask(cookie, "show").status_code == 409:
            pass
        for key in ("north-key", "south-key"):
            answer = running.ask(running.cookie(key), "pick", u=0.5, v=0.5)
            assert answer.status_code == 409  # a view of that name in another session is another view


def test_a_view_asks_with_its_own_origin_and_session(running):
    cookie = running.cookie("north-key")
    with running.client() as client:
        for origin in ("http://evil.example", "null"):
            headers = {"Cookie": cookie, "Origin": origin}
            assert client.post("/view/scene/view-0001/show", json={}, headers=headers).status_code == 403
        assert client.post("/view/scene/view-0001/show", json={}).status_code == 404
        assert client.get("/view/scene/view-0001/camera").status_code == 404
        assert client.post("/view/scene/x/show", json={}, headers={"Cookie": cookie}).status_code == 404
        huge = client.post("/view/scene/view-0001/show", content=b"x" * 3_000_000, headers={"Cookie": cookie})
        assert huge.status_code == 413
        broken = client.post("/view/scene/view-0001/show", content=b"[" * 100_000, headers={"Cookie": cookie})
        assert broken.status_code == 422


def test_a_plan_lies_where_it_is_placed_and_can_be_hidden(looking, source):
    picture = io.BytesIO()
    Image.new("RGB", (40, 20), "white").save(picture, "PNG")
    source.plans["floor-0"] = picture.getvalue()
    tower = source.by_organisation["north"][0]
    plan = PlacedPlan("a" * 64, 20.0, 10.0, 100.0, 40.0, np.pi / 2)
    floors = (replace(tower.floors[0], plan=plan), *tower.floors[1:])
    source.by_organisation["north"][0] = replace(tower, floors=floors)
    looking.ask("show", floor_id="floor-0")
    looking.canvas.read_until(lambda p: any(m["name"] == "/floor 0/plan" for m in p.of_type("ImageMessage")))
    looking.canvas.read_for(0.3)
    told = {m["type"]: m for m in looking.canvas.messages if m.get("name") == "/floor 0/plan"}
    centre = [100.0 - 5.0 - 112.0, 40.0 + 10.0 - 47.0]  # a quarter turn about the corner, less the local origin
    assert told["SetPositionMessage"]["position"][:2] == pytest.approx(centre)
    assert told["SetOrientationMessage"]["wxyz"] == pytest.approx([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    assert told["ImageMessage"]["props"]["render_width"] == 20.0
    looking.ask("show", floor_id="floor-0", plan=False)
    looking.canvas.read_for(0.5)
    shown = [m["visible"] for m in looking.canvas.messages
             if m["type"] == "SetSceneNodeVisibilityMessage" and m["name"] == "/floor 0/plan"]  # fmt: skip
    assert shown[-1] is False


def test_views_long_left_are_forgotten_and_those_looked_at_are_not(running, open_page, monkeypatch):
    monkeypatch.setattr("app.viewer.viser_pool._MOST_LEFT", 2)
    cookie = running.cookie("north-key")
    with running.websocket(cookie, "/view/scene/staying-1") as kept:
        open_page(kept)
        assert running.ask(cookie, "show", "staying-1").status_code == 200
        (viewer,) = running.viewer.pool.running().values()
        for number in range(5):
            view = f"leaving-{number}"
            with running.websocket(cookie, f"/view/scene/{view}") as socket:
                open_page(socket)
                assert running.ask(cookie, "show", view, floor_id="floor-0").status_code == 200
            while not next(each for name, each in viewer.scenes.items() if name.endswith(view)).has_left:
                time.sleep(0.01)
        assert len(viewer.scenes) <= 4  # the one looked at, two that left before the last came, and the last
        assert running.ask(cookie, "show", "staying-1", layer="sd").status_code == 200
