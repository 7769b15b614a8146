"""Signing in, and the page behind it, on a real server at a real port."""

import io
import socket
import sys
import time
from pathlib import Path
from subprocess import run

import numpy as np
import pytest
from PIL import Image
from websockets.exceptions import ConnectionClosed

from app.services.reach import Reach
from app.viewer.page import COOKIE, ViewerApp
from app.viewer.proxy import CLOSE_FULL


def until(true, patience_s=20.0):
    give_up = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < give_up
        time.sleep(0.01)


def test_a_stranger_is_shown_the_sign_in_page_and_nothing_else(running):
    with running.client() as client:
        answer = client.get("/view/?building=tower&floor=floor-0")
        assert answer.status_code == 200
        assert 'type="password"' in answer.text
        assert 'value="tower"' in answer.text
        assert 'value="floor-0"' in answer.text
        assert "http://" not in answer.text
        assert "https://" not in answer.text
        assert "<script" not in answer.text
        policy = answer.headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert answer.headers["cache-control"] == "no-store"
        assert client.get("/view/session").status_code == 401
        assert client.get("/view/content").status_code == 401
        assert client.get("/view/scene/view-0001").status_code == 401
    assert running.viewer.pool.running() == {}


def test_what_a_link_asks_for_is_escaped(running):
    with running.client() as client:
        assert "<b>" not in client.get("/view/", params={"building": '"><b>'}).text


@pytest.mark.parametrize("key", ["", "no-such-key", "locate-key"])
def test_a_wrong_or_too_small_key_signs_nobody_in(running, key):
    with running.client() as client:
        answer = client.post("/view/session", data={"key": key})
        assert answer.status_code == 401
        assert "set-cookie" not in answer.headers
        assert 'role="alert"' in answer.text
    assert len(running.viewer.signed_in) == 0


def test_the_cookie_is_random_and_kept_from_scripts_and_other_sites(running):
    with running.client() as client:
        answer = client.post("/view/session", data={"key": "north-key", "floor": "floor-0", "layer": "sd", "evil": "x"})
        assert answer.status_code == 303
        assert answer.headers["location"] == "/view/?floor=floor-0&layer=sd"
        header = answer.headers["set-cookie"].lower()
        assert all(flag in header for flag in ("httponly", "samesite=strict", "path=/view", "max-age=28800"))
        assert "north-key" not in header
        assert answer.cookies[COOKIE] != running.cookie("north-key").partition("=")[2]


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None])
def test_only_our_own_form_signs_in_or_out(running, origin):
    headers = {"Origin": origin} if origin else {}
    with running.client() as client:
        del client.headers["origin"]
        for path in ("/view/session", "/view/sign-out"):
            assert client.post(path, data={"key": "north-key"}, headers=headers).status_code == 403
    assert len(running.viewer.signed_in) == 0


def test_a_huge_form_is_refused(running):
    with running.client() as client:
        assert client.post("/view/session", data={"key": "x" * 10_000}).status_code == 413


def test_the_page_runs_its_own_scripts_only(running):
    cookie = {"Cookie": running.cookie("north-key")}
    with running.client() as client:
        page = client.get("/view/?floor=floor-0", headers=cookie)
        assert page.status_code == 200
        policy = page.headers["content-security-policy"]
        assert "script-src 'self';" in policy
        assert "frame-ancestors 'none'" in policy
        assert "set-cookie" not in page.headers
        assert 'action="sign-out"' in page.text
        for asset in ("page.js", "page.css", "server.js", "mark.svg"):
            answer = client.get(f"/view/assets/{asset}")
            assert answer.status_code == 200
            again = client.get(f"/view/assets/{asset}", headers={"If-None-Match": answer.headers["etag"]})
            assert again.status_code == 304
        for missing in ("page.py", "..%2Fpage.py", "no.js"):
            assert client.get(f"/view/assets/{missing}").status_code == 404
        assert client.get("/view/session", headers=cookie).status_code == 204


def test_the_canvas_is_visers_client_with_our_policy(running):
    cookie = {"Cookie": running.cookie("north-key")}
    with running.client() as client:
        moved = client.get("/view/scene/view-0001?websocket=wss://evil.example", headers=cookie)
        assert moved.status_code == 303
        assert moved.headers["location"] == "/view/scene/view-0001"  # the foreign address is gone
        page = client.get("/view/scene/view-0001", headers=cookie)
        assert page.status_code == 200
        assert '<div id="root"></div>' in page.text
        assert "connect-src 'self'" in page.headers["content-security-policy"]
        assert "frame-ancestors 'self'" in page.headers["content-security-policy"]
        again = client.get("/view/scene/view-0002", headers={**cookie, "If-None-Match": page.headers["etag"]})
        assert again.status_code == 304
        plain = client.get("/view/scene/view-0001", headers={**cookie, "Accept-Encoding": "identity"})
        assert plain.content == page.content
        assert client.get("/view/scene/x", headers=cookie).status_code == 404


def test_the_pickers_offer_ones_own_buildings_and_say_what_the_key_may(running):
    with running.client() as client:
        north, south = (
            client.get("/view/content", headers={"Cookie": running.cookie(key)}).json()
            for key in ("north-key", "south-key")
        )
    assert [b["name"] for b in north["buildings"]] == ["Tower", "Barn"]
    assert north["scopes"] == ["map:read"]
    assert north["buildings"][0]["floors"][0] == {"id": "floor-0", "name": "Ground", "ordinal": 0, "map_id": "map-0"}
    assert [b["name"] for b in south["buildings"]] == ["Secret shed"]


def test_the_poster_is_the_layer_from_above(running, source):
    cookie = {"Cookie": running.cookie("north-key")}
    with running.client() as client:
        assert client.get("/view/poster.png").status_code == 401
        answer = client.get("/view/poster.png?floor=floor-0&layer=sd", headers=cookie)
        assert answer.headers["content-type"] == "image/png"
        picture = np.asarray(Image.open(io.BytesIO(answer.content)))
        measured = source.grids["map-0"].measured[0]
        np.testing.assert_array_equal(picture[::-1, :, 3] == 255, measured)  # north is up
        other = client.get("/view/poster.png?floor=floor-0&layer=norm", headers=cookie)
        assert other.content != answer.content
        assert client.get("/view/poster.png?floor=floor-2", headers=cookie).status_code == 204  # no map
        assert client.get("/view/poster.png?floor=floor-0&layer=nonsense", headers=cookie).status_code == 204
        theirs = client.get("/view/poster.png?floor=floor-s", headers=cookie)
        own = client.get("/view/poster.png", headers=cookie)
        assert theirs.content == own.content  # a foreign link shows one's own first floor


def test_a_key_limited_to_a_building_has_a_page_and_a_server_of_its_own(running):
    with running.client() as client:
        for key, buildings in (("north-key", ["Tower", "Barn"]), ("barn-key", ["Barn"])):
            cookie = {"Cookie": running.cookie(key)}
            content = client.get("/view/content", headers=cookie).json()
            assert [each["name"] for each in content["buildings"]] == buildings
            assert client.get("/view/scene/view-0001", headers=cookie).status_code == 200
        poster = client.get("/view/poster.png?floor=floor-0", headers=cookie)
        assert poster.status_code == 204, "there is no map in the barn, and the tower's is not shown"
    assert set(running.viewer.pool.running()) == {Reach("north"), Reach("north", frozenset({"barn"}))}


def test_so_many_servers_run_and_the_one_unused_for_longest_makes_room(running, open_page, monkeypatch):
    monkeypatch.setattr("app.viewer.viser_pool._MOST_SERVERS", 2)
    north, barn, south = (running.cookie(key) for key in ("north-key", "barn-key", "south-key"))
    reaches = {"north": Reach("north"), "barn": Reach("north", frozenset({"barn"})), "south": Reach("south")}

    def look(cookie):
        with running.client() as client:
            return client.get("/view/scene/view-0001", headers={"Cookie": cookie})

    def are_running(*names):
        return set(running.viewer.pool.running()) == {reaches[name] for name in names}

    def nobody_looks():
        return not any(viewer.visitors for viewer in running.viewer.pool.running().values())

    until(nobody_looks)  # what signing in began is done
    assert [look(cookie).status_code for cookie in (north, barn, north, south)] == [200] * 4
    assert are_running("north", "south")
    with running.websocket(north) as looking, running.websocket(south) as also:
        open_page(looking)
        open_page(also)
        refused = look(barn)
        assert refused.status_code == 503
        assert refused.headers["Retry-After"] == "60"
        assert "2 3-D views" in refused.json()["detail"]
        assert running.ask(barn, "show").status_code == 503
        with running.websocket(barn) as socket, pytest.raises(ConnectionClosed) as closed:
            socket.recv(timeout=5)
        assert closed.value.rcvd.code == CLOSE_FULL
        assert are_running("north", "south"), "nobody who looks is disturbed"
        assert looking.ping().wait(5)
    until(nobody_looks)
    assert look(barn).status_code == 200
    monkeypatch.setattr("app.viewer.viser_pool._MOST_OF_ONE", 1)
    until(nobody_looks)
    with running.websocket(barn) as looking:
        open_page(looking)
        assert look(south).status_code == 200
        assert are_running("barn", "south")
        assert "1 3-D views of sets of buildings of this organisation" in look(north).json()["detail"]


def test_signing_out_makes_the_cookie_worthless(running):
    cookie = {"Cookie": running.cookie("north-key")}
    with running.client() as client:
        assert client.post("/view/sign-out", headers=cookie).headers["location"] == "/view/"
        assert client.get("/view/session", headers=cookie).status_code == 401


def test_a_session_expires_and_a_revoked_key_loses_the_page(serve, keys, source):
    now = [0.0]
    running = serve(ViewerApp(keys, source, session_seconds=1000.0, clock=lambda: now[0]))
    cookie = {"Cookie": running.cookie("north-key")}
    with running.client() as client:
        now[0] = 999.0
        assert client.get("/view/session", headers=cookie).status_code == 204
        now[0] = 1000.0
        assert client.get("/view/session", headers=cookie).status_code == 401
        assert len(running.viewer.signed_in) == 0
        cookie = {"Cookie": running.cookie("north-key")}
        del keys.keys["north-key"]
        now[0] += 61.0
        assert client.get("/view/session", headers=cookie).status_code == 401


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux's table of sockets")
def test_viser_listens_on_loopback_only(running):
    with running.client() as client:
        client.get("/view/scene/view-0001", headers={"Cookie": running.cookie("north-key")})
    (viewer,) = running.viewer.pool.running().values()
    port = viewer.server.get_port()
    tables = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
    listening = [line.split() for table in tables for line in table.read_text().splitlines()[1:]]
    addresses = {f[1].split(":")[0] for f in listening if f[3] == "0A" and int(f[1].split(":")[1], 16) == port}
    assert addresses == {"0100007F"}
    with socket.create_connection(("127.0.0.1", port), timeout=5):
        pass


def test_a_servers_life_ends_when_nobody_has_looked_for_a_while(serve, keys, source):
    running = serve(ViewerApp(keys, source, idle_seconds=0.2))
    with running.client() as client:
        client.get("/view/scene/view-0001", headers={"Cookie": running.cookie("north-key")})
    (viewer,) = running.viewer.pool.running().values()
    thread = viewer.server._websock_server._server_thread
    thread.join(timeout=10)
    assert not thread.is_alive()
    with running.client() as client:  # and begins again with the next visitor
        assert client.get("/view/scene/view-0001", headers={"Cookie": running.cookie("north-key")}).status_code == 200


def test_viser_and_matplotlib_are_loaded_by_the_first_visit_only():
    code = (
        "import sys, app.viewer.page, app.viewer.heatmap; print({'viser', 'matplotlib', 'sklearn'} & set(sys.modules))"
    )
    assert run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"
