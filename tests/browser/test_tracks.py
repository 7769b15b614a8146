"""Tracks on the page: devices that are followed, seen as they go, in front of a real server."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import expect

pytestmark = pytest.mark.browser

CORNERS_M = np.array([[3.0, 3.0], [14.0, 3.0], [14.0, 9.0], [5.0, 9.0], [5.0, 13.0], [20.0, 13.0], [20.0, 4.0]])
TURN_RAD = 0.8  # of the device's level frame


@pytest.fixture
def steps(town: Any) -> Callable[..., list[dict[str, Any]]]:
    """Steps of a device carried over floor 0, every decimetre; `elsewhere_m` away from where it says it is."""

    def make(first: int, last: int, elsewhere_m: float = 0.0) -> list[dict[str, Any]]:
        p = _places_m(town, last)
        c, s = np.cos(TURN_RAD), np.sin(TURN_RAD)
        back = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        moved = (p - p[0]) @ back
        B = town.world.field_uT(p + np.array([elsewhere_m, 0.0, 0.0])) @ back
        B += np.random.default_rng(3).normal(0.0, 0.3, B.shape)
        return [
            {"number": k, "t_s": 0.1 * k, "displacement_m": moved[k].tolist(), "b_ut": B[k].tolist()}
            for k in range(first, last)
        ]

    return make


def _places_m(town: Any, count: int) -> np.ndarray:
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(CORNERS_M, axis=0), axis=1))])
    x, y = (np.interp(0.1 * np.arange(count), along, CORNERS_M[:, k]) for k in (0, 1))
    return np.column_stack([x, y, np.full(count, town.world.probes_m[0][0, 2])])


@pytest.fixture
def begin(town: Any) -> Iterator[Callable[[str], str]]:
    """Begin a track in the building; all are removed afterwards."""
    made: list[str] = []

    def make(name: str) -> str:
        body = {"building_id": town.building, "frame": "level", "name": name, "seed": 7, "options": {"particles": 1000}}
        answer = town.api.post("/v1/tracks", json=body)
        assert answer.status_code == 201, answer.text
        made.append(answer.json()["id"])
        return made[-1]

    yield make
    for track in made:
        town.api.delete(f"/v1/tracks/{track}")


def _send(town: Any, track: str, steps: list[dict[str, Any]]) -> dict[str, Any]:
    """The last estimate."""
    for k in range(0, len(steps), 25):
        answer = town.api.post(f"/v1/tracks/{track}/steps", json={"steps": steps[k : k + 25]})
        assert answer.status_code == 200, answer.text
    estimate: dict[str, Any] = answer.json()["estimate"]
    return estimate


def _said(estimate: dict[str, Any]) -> str:
    x, y = estimate["position_m"][:2]
    return f"x {x:.2f} m, y {y:.2f} m"


@pytest.mark.slow
def test_a_device_is_seen_as_it_is_found_and_goes_on(seat, town, begin, steps):
    me = seat().open(f"?floor={town.floors[0]}")
    me.page.get_by_label("Field arrows").uncheck()
    me.tab("Tracks")
    expect(me.page.locator("#tracks-none")).to_contain_text("POST /v1/tracks")
    empty = me.settled()
    track = begin("trolley 3")
    item = me.page.get_by_role("listitem").filter(has_text="trolley 3")
    expect(item.locator(".badge")).to_have_text("searching")
    expect(item).to_contain_text("no step was followed yet")
    expect(me.page.locator("#tracks-none")).to_be_hidden()
    estimate = _send(town, track, steps(0, 200))
    assert estimate["state"] == "converged"
    expect(item.locator(".badge")).to_have_text("converged")
    expect(item).to_contain_text(_said(estimate))
    expect(item).to_contain_text(re.compile("last step (just now|\\d+ s ago)"))
    expect(me.page.locator("#tracks-told")).to_have_text("trolley 3: converged, Floor 0.")
    assert (me.settled() != empty).any(axis=-1).mean() > 0.02
    button = item.get_by_role("button")
    button.focus()
    button.press("Enter")
    expect(button).to_have_attribute("aria-pressed", "true")
    expect(me.page).to_have_url(re.compile(f"track={track}"))
    near = me.settled()
    estimate = _send(town, track, steps(0, 330)[200:])
    expect(item).to_contain_text(_said(estimate))
    assert (me.settled() != near).any(axis=-1).mean() > 1e-3
    me.keep("tracks")
    me.page.locator("#floor").select_option(town.floors[1])
    expect(button).to_have_attribute("aria-pressed", "false")
    expect(item).to_contain_text("Floor 0")
    town.api.post(f"/v1/tracks/{track}/end")
    expect(item).to_have_count(0)
    expect(me.page.locator("#tracks-told")).to_have_text("trolley 3 is no longer active.")


@pytest.mark.slow
def test_a_link_leads_to_a_track_and_only_its_organisation(seat, town, begin, steps):
    track = begin("lift 9")
    _send(town, track, steps(0, 200))
    link = f"?floor={town.floors[1]}&track={track}"
    me = seat().open(link)
    expect(me.page.get_by_role("button", name="lift 9")).to_have_attribute("aria-pressed", "true")
    expect(me.page.locator("#floor")).to_have_value(town.floors[0])
    lost = _send(town, track, steps(0, 330, elsewhere_m=6.0)[200:])
    assert lost["state"] == "lost"
    expect(me.page.get_by_role("listitem").locator(".badge")).to_have_text("lost")
    expect(me.page.get_by_role("listitem")).to_contain_text(lost["reason"])
    me.page.context.close()
    you = seat()
    you.sign_in(link, key=town.other_key)
    expect(you.page.locator("#tracks-told")).to_contain_text("not your organisation's", timeout=30_000)
    assert you.page.get_by_role("listitem").count() == 0
    assert "lift 9" not in you.page.content()
    asked = you.page.evaluate("(path) => fetch(path).then((a) => a.text())", f"v1/tracks?building_id={town.building}")
    assert "lift 9" not in asked
