"""What passes between a browser and its viser server, and what does not."""

import time
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from app.services.reach import Reach
from app.viewer.page import ViewerApp
from app.viewer.proxy import CLOSE_SIGNED_OUT, CLOSE_UNREACHABLE, passes


def encoded(**fields):
    return msgspec.msgpack.encode(fields)


def test_only_cameras_pass():
    assert passes(encoded(type="ViewerCameraMessage", position=[0, 0, 0]))
    others = ("GuiUpdateMessage", "ShareUrlRequest", "ShareUrlDisconnect", "FileTransferStartUpload",
              "TransformControlsUpdateMessage", "GetRenderResponseMessage", "NoSuchMessage", "", None, 7)  # fmt: skip
    assert not any(passes(encoded(type=kind)) for kind in others)


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


def test_share_requests_and_controls_never_reach_viser(running, open_page):
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        page = open_page(socket)
        running.ask(cookie, "show")
        page.read_until(lambda p: p.labels())
        server = running.viewer.pool.running()[Reach("north")].server
        page.send({"type": "ShareUrlRequest"})
        page.send({"type": "ShareUrlDisconnect"})
        page.send({"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1}})
        page.send(type(page).CAMERA)  # later messages still arrive
        running.ask(cookie, "show", layer="gradient")
        page.read_until(lambda p: len(p.of_type("ImageMessage")) == 4)
        assert page.of_type("ShareUrlUpdated") == []
        assert server._share_tunnel is None
    assert server.request_share_url() is None  # not even asked directly


def test_a_connection_that_bypasses_the_proxy_is_shown_nothing(running, open_page):
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        open_page(socket)
        assert running.ask(cookie, "show").status_code == 200
        (viewer,) = running.viewer.pool.running().values()
        protocol = [Subprotocol(socket.subprotocol)]
        for query in ("secret=guess", f"secret=guess&view={next(iter(viewer.scenes))}", ""):
            address = f"ws://127.0.0.1:{viewer.server.get_port()}/?{query}"
            with connect(address, subprotocols=protocol, proxy=None) as direct:
                page = open_page(direct)
                page.read_for(1.0)
            assert page.labels() == []
            assert page.of_type("ImageMessage") == []
            assert "Tower" not in repr(page.messages)
        assert len(viewer.scenes) == 1


def test_two_browsers_do_not_move_each_other_and_outlive_each_other(running, open_page):
    cookie = running.cookie("north-key")
    with running.websocket(cookie, "/view/scene/first-view") as kept:
        first = open_page(kept)
        running.ask(cookie, "show", "first-view")
        first.read_until(lambda p: len(p.labels()) == 3 and p.of_type("ArrowMessage"))
        with running.websocket(cookie, "/view/scene/other-view") as other:
            second = open_page(other)
            running.ask(cookie, "show", "other-view", floor_id="floor-0")
            second.read_until(lambda p: p.labels())
            first.read_for(0.5)
            first.messages.clear()
            running.ask(cookie, "show", "other-view", floor_id="floor-0", layer="gradient", arrows=False, camera="top")
            second.read_for(1.0)
            first.read_for(0.3)
            assert first.messages == []
            other.send("text is not spoken here")
            other.send(b"\x81\xa4type\xb3ViewerCameraMessage")  # a camera without anything: viser drops the speaker
            other.socket.close()  # and gone without a word
        first.messages.clear()
        assert running.ask(cookie, "show", "first-view", floor_id="floor-1").status_code == 200
        first.read_until(lambda p: "First" in p.labels())
        assert kept.ping().wait(5)


def test_a_view_that_connects_again_shows_what_it_showed(running, open_page):
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        open_page(socket)
        running.ask(cookie, "show", floor_id="floor-1", layer="sd")
        mode = {"floor_id": "floor-1", "position_m": [105.0, 42.0, 5.2], "probability": 0.9}
        assert running.ask(cookie, "mark", modes=[mode]).status_code == 200
    with running.websocket(cookie) as socket:
        page = open_page(socket)
        page.read_until(lambda p: {"First", "90 %"} <= set(p.labels()))
        page.read_for(0.3)
        assert len(page.of_type("ImageMessage")) == 1
        assert page.of_type("SetCameraPositionMessage") == []  # its camera is where the browser left it


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
        running.ask(cookie, "show")
        page.read_until(lambda p: p.labels())
        running.viewer.pool.running()[Reach("north")].server.stop()
        with pytest.raises(ConnectionClosed):
            page.read_until(lambda p: False, seconds=10)
    with running.websocket(cookie) as socket, pytest.raises(ConnectionClosed) as closed:  # the browser tries again,
        socket.recv(timeout=10)
    assert closed.value.rcvd.code == CLOSE_UNREACHABLE
    while Reach("north") in running.viewer.pool.running():
        time.sleep(0.01)
    with running.websocket(cookie) as socket:  # and again
        page = open_page(socket)
        assert running.ask(cookie, "show").status_code == 200
        page.read_until(lambda p: p.labels())


def test_coordinates_are_sent_in_single_precision_about_a_local_origin(running, open_page):
    """viser 1.1 would send half precision for point clouds; a hundred metres out that is 6 cm steps."""
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        page = open_page(socket)
        running.ask(cookie, "show", floor_id="floor-0")
        page.read_until(lambda p: p.of_type("ArrowMessage"))
    assert page.of_type("PointCloudMessage") == []
    assert all(m["props"]["points"]["dtype"] == "<f4" for m in page.of_type("ArrowMessage"))
    positions = [m["position"] for m in page.of_type("SetPositionMessage")]
    assert np.abs(np.asarray(positions)).max() < 30.0  # the building stands at x = 100 to 124 m


def test_names_are_text_whatever_they_say(running, source, open_page):
    tower = source.by_organisation["north"][0]
    name = "![x](/etc/passwd) <script>alert(1)</script>"
    source.by_organisation["north"] = [replace(tower, name=name, floors=(replace(tower.floors[0], name=name),))]
    cookie = running.cookie("north-key")
    with running.websocket(cookie) as socket:
        page = open_page(socket)
        told = running.ask(cookie, "show").json()
        page.read_until(lambda p: p.labels())
    assert told["floors"][0]["name"] == name  # as JSON; the page sets it as text
    assert page.labels() == [name]
    assert page.of_type("GuiMarkdownMessage") == page.of_type("GuiHtmlMessage") == []
