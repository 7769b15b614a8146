"""What passes between a browser and its viser server, and what does not."""

import time
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from app.viewer.heatmap import heatmap_png
from app.viewer.page import ViewerApp
from app.viewer.proxy import CLOSE_SIGNED_OUT, CLOSE_UNREACHABLE, passes


def encoded(**fields):
    return msgspec.msgpack.encode(fields)


def test_only_cameras_and_control_values_pass():
    assert passes(encoded(type="ViewerCameraMessage", position=[0, 0, 0]))
    assert passes(encoded(type="GuiUpdateMessage", uuid="a", updates={"value": 3}))
    assert not passes(encoded(type="GuiUpdateMessage", uuid="a", updates={"value": 3, "update_cb": "x"}))
    assert not passes(encoded(type="GuiUpdateMessage", uuid="a", updates=[1]))
    for kind in ("ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload", "TransformControlsUpdateMessage",
                 "GetRenderResponseMessage", "NoSuchMessage", "", None, 7):  # fmt: skip
        assert not passes(encoded(type=kind))


@pytest.mark.parametrize(
    "message", [b"", b"\x00", b"\xff" * 9, msgspec.msgpack.encode([1, 2]), b"\x91" * 5000, b"\x81\xa4type\xc1"]
)
def test_what_cannot_be_read_does_not_pass(message):
    assert not passes(message)


def test_large_messages_do_not_pass():
    assert not passes(encoded(type="ViewerCameraMessage", position="x" * 100_000))


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None])
def test_a_foreign_origin_is_refused_before_the_handshake(running, origin):
    cookie = running.cookie("north-key")
    with pytest.raises(InvalidStatus) as refused:
        running.websocket(cookie, origin=origin)
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("cookie", [None, "isodyn_view=made-up"])
def test_without_a_session_the_socket_is_closed(running, cookie):
    with running.websocket(cookie) as socket, pytest.raises(ConnectionClosed) as closed:
        socket.recv(timeout=5)
    assert closed.value.rcvd.code == CLOSE_SIGNED_OUT
    assert running.viewer.pool.running() == {}


def test_a_page_shows_its_organisations_building_and_follows_its_link(running, open_page):
    with running.websocket(running.cookie("north-key"), "/view/buildings/tower/floors/floor-1") as socket:
        page = open_page(socket)
        page.read_until(lambda p: p.labels())
        page.read_for(0.5)
        assert page.labels() == ["First"]
        assert page.control("Building")["props"]["options"] == ["Tower", "Barn"]
        assert page.of_type("ImageMessage")
        assert page.of_type("ArrowMessage")
        assert page.of_type("LineSegmentsMessage")
    with running.websocket(running.cookie("north-key"), "/view/buildings/tower") as socket:
        page = open_page(socket)
        page.read_until(lambda p: len(p.labels()) == 3)
        assert page.labels() == ["Ground", "First", "Roof: no map yet"]


def test_controls_change_what_is_drawn(running, open_page):
    with running.websocket(running.cookie("north-key"), "/view/buildings/tower/floors/floor-0") as socket:
        page = open_page(socket)
        page.read_until(lambda p: p.labels() and p.of_type("ArrowMessage"))
        page.read_for(0.5)
        before = len(page.of_type("ImageMessage"))
        page.choose("Layer", "Uncertainty (1 sd, all components)")
        page.read_until(lambda p: len(p.of_type("ImageMessage")) == before + 1)
        page.choose("Floor", "All floors")
        page.read_until(lambda p: "First" in p.labels())
        page.choose("Floor", "Secret shed")  # a name of nobody's floor shows no floor at all
        page.choose("Building", "Secret shed")
        page.read_for(1.0)
    assert "Shed floor" not in page.labels()
    assert all(organisation == "north" for organisation, _ in running.viewer.pool._source.asked)


def test_an_organisation_never_sees_anothers_objects(running, open_page):
    seen = {}
    for key in ("north-key", "south-key"):
        with running.websocket(running.cookie(key), "/view/buildings/shed/floors/floor-s") as socket:
            page = open_page(socket)
            page.read_until(lambda p: p.labels())
            page.read_for(0.5)
            seen[key] = repr(page.messages)
    assert "Tower" in seen["north-key"]
    assert "hed" not in seen["north-key"]
    assert "Secret shed" in seen["south-key"]
    assert "Tower" not in seen["south-key"]
    servers = running.viewer.pool.running()
    assert servers["north"].server is not servers["south"].server


def test_names_are_text_whatever_they_say(running, source, open_page, tmp_path):
    """viser would read a picture named in Markdown from the server's disk."""
    picture = tmp_path / "secret.png"
    picture.write_bytes(heatmap_png(source.grids["map-0"]))
    tower = source.by_organisation["north"][0]
    name = f"![x]({picture}) <script>alert(1)</script>"
    floors = (replace(tower.floors[0], name=name), replace(tower.floors[1], name=name))
    source.by_organisation["north"] = [replace(tower, name=name, floors=floors)]
    with running.websocket(running.cookie("north-key")) as socket:
        page = open_page(socket)
        page.read_until(lambda p: len(p.labels()) == 2)
        page.read_for(0.5)
    assert page.control("Building")["props"]["options"] == [name]
    texts = [m["updates"]["content"] for m in page.of_type("GuiUpdateMessage") if "content" in m["updates"]]
    assert any(f"![x]({picture}) &lt;script&gt;" in text for text in texts)
    assert "data:image" not in repr(page.messages)
    assert "<script>" not in "".join(texts)


def test_share_requests_never_reach_viser(running, open_page):
    with running.websocket(running.cookie("north-key")) as socket:
        page = open_page(socket)
        page.read_until(lambda p: p.labels())
        server = running.viewer.pool.running()["north"].server
        page.send({"type": "ShareUrlRequest"})
        page.send({"type": "ShareUrlDisconnect"})
        page.choose("Layer", "Gradient along the floor")  # later messages still arrive
        page.read_until(lambda p: any("Gradient" in str(m) for m in p.of_type("GuiUpdateMessage")))
        assert page.of_type("ShareUrlUpdated") == []
        assert server._share_tunnel is None
    assert server.request_share_url() is None  # not even asked directly


def test_a_connection_that_bypasses_the_proxy_is_shown_nothing(running, open_page):
    with running.websocket(running.cookie("north-key")) as socket:
        open_page(socket).read_until(lambda p: p.labels())
        port = running.viewer.pool.running()["north"].server.get_port()
        protocol = [Subprotocol(socket.subprotocol)]
        with connect(f"ws://127.0.0.1:{port}/?secret=guess", subprotocols=protocol, proxy=None) as direct:
            page = open_page(direct)
            page.read_for(1.5)
    assert page.labels() == []
    assert page.of_type("ImageMessage") == []
    assert "Tower" not in repr(page.messages)


def test_two_browsers_do_not_move_each_other_and_outlive_each_other(running, open_page):
    cookie = running.cookie("north-key")
    with running.websocket(cookie, "/view/buildings/tower") as kept:
        first = open_page(kept)
        first.read_until(lambda p: len(p.labels()) == 3)
        with running.websocket(cookie, "/view/buildings/tower/floors/floor-0") as other:
            second = open_page(other)
            second.read_until(lambda p: p.labels())
            first.read_for(0.5)
            first.messages.clear()
            second.choose("Layer", "Gradient along the floor")
            second.choose("Field arrows", False)
            second.read_for(1.0)
            first.read_for(0.3)
            assert [m for m in first.messages if m["type"] != "ViewerCameraMessage"] == []
            other.send("text is not spoken here")
            other.send(b"\x81\xa4type\xb3ViewerCameraMessage")  # a camera without anything: viser drops the speaker
            other.socket.close()  # and gone without a word
        first.messages.clear()
        first.send({"type": "GuiUpdateMessage", "uuid": "unknown", "updates": {"value": 1}})
        first.send(type(first).CAMERA)
        assert kept.ping().wait(5)


def test_a_socket_closes_when_its_session_ends(serve, keys, source, open_page):
    running = serve(ViewerApp(keys, source, session_seconds=1.5))
    with running.websocket(running.cookie("north-key")) as socket:
        page = open_page(socket)
        with pytest.raises(ConnectionClosed) as closed:
            page.read_until(lambda p: False, seconds=10)
    assert closed.value.rcvd.code == CLOSE_SIGNED_OUT


def test_signing_out_closes_the_sockets_of_that_session_only(running, open_page):
    mine, other = running.cookie("north-key"), running.cookie("north-key")
    with running.websocket(mine) as leaving, running.websocket(other) as staying:
        page = open_page(leaving)
        with running.client() as client:
            client.post("/view/sign-out", headers={"Cookie": mine})
        with pytest.raises(ConnectionClosed) as closed:
            page.read_until(lambda p: False, seconds=10)
        assert closed.value.rcvd.code == CLOSE_SIGNED_OUT
        assert staying.ping().wait(5)


def test_a_stopped_viser_server_is_replaced(running, open_page):
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        page = open_page(socket)
        page.read_until(lambda p: p.labels())
        running.viewer.pool.running()["north"].server.stop()
        with pytest.raises(ConnectionClosed):
            page.read_until(lambda p: False, seconds=10)
    with running.websocket(cookie) as socket, pytest.raises(ConnectionClosed) as closed:  # the browser tries again,
        socket.recv(timeout=10)
    assert closed.value.rcvd.code == CLOSE_UNREACHABLE
    while "north" in running.viewer.pool.running():
        time.sleep(0.01)
    with running.websocket(cookie) as socket:  # and again
        page = open_page(socket)
        page.read_until(lambda p: p.labels())


def test_coordinates_are_sent_in_single_precision_about_a_local_origin(running, open_page):
    """viser 1.1 would send half precision for point clouds; a hundred metres out that is 6 cm steps."""
    with running.websocket(running.cookie("north-key"), "/view/buildings/tower/floors/floor-0") as socket:
        page = open_page(socket)
        page.read_until(lambda p: p.of_type("ArrowMessage"))
    assert page.of_type("PointCloudMessage") == []
    assert all(m["props"]["points"]["dtype"] == "<f4" for m in page.of_type("ArrowMessage"))
    positions = [m["position"] for m in page.of_type("SetPositionMessage")]
    assert np.abs(np.asarray(positions)).max() < 30.0  # the building stands at x = 100 to 124 m
