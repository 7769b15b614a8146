"""The page as people meet it, in front of a real server: what they do, and what they then see."""

import gzip
import json
import math
import re

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import expect

from tests.browser.conftest import colourful_share

pytestmark = pytest.mark.browser


def test_a_wrong_key_is_told_so_and_a_right_one_sees_the_building(seat, town):
    me = seat()
    me.sign_in(key="isd_wrong")
    expect(me.page.get_by_role("alert")).to_contain_text("not known")
    me.open()
    assert colourful_share(me.canvas()) > 0.05
    assert me.page.title() == "Isodyn"
    assert "Floor 0" in me.page.locator("#words").inner_text()
    expect(me.page.get_by_label("Magnitude |B|, µT")).to_be_visible()
    assert me.page.evaluate("document.cookie") == ""
    me.keep("page")
    me.page.get_by_role("button", name="Sign out").click()
    me.page.get_by_label("API key").wait_for()


@pytest.mark.slow
def test_every_layer_is_another_picture_with_its_own_legend(seat, town):
    me = seat().open(f"?floor={town.floors[0]}")
    select = me.page.get_by_label("Layer")
    offered = select.locator("option").evaluate_all("(all) => all.map((o) => [o.value, o.textContent])")
    names = [name for name, _ in offered]
    assert {"norm", "bx", "by", "bz", "inclination", "sd", "gradient", "expected_error", "coverage", "conflict"} <= set(
        names
    )
    me.page.get_by_label("Field arrows").uncheck()
    pictures = {}
    for name, title in offered:
        select.select_option(name)
        expect(me.page.locator("#legend .legend-of").first).to_contain_text(title)
        pictures[name] = me.settled()
        assert me.page.locator("#about-layer").inner_text() != ""
        assert f"layer={name}" in me.page.url
        if name == "expected_error":
            me.keep(f"layer-{name.replace('_', '-')}")
    for k, name in enumerate(names):
        for other in names[:k]:
            differs = (pictures[name] != pictures[other]).any(axis=-1).mean()
            assert differs > 0.02, (name, other)


@pytest.mark.slow
def test_walks_arrows_and_outline_come_and_go(seat, town):
    me = seat().open(f"?floor={town.floors[0]}")
    for label in ("Field arrows", "Survey walks", "Floor outline"):
        box = me.page.get_by_label(label)
        before = me.settled()
        box.set_checked(not box.is_checked())
        me.page.wait_for_timeout(500)
        after = me.settled()
        assert (before != after).any(axis=-1).mean() > 1e-3, label
        if label == "Survey walks":
            expect(me.page.locator("#legend")).to_contain_text("measured less map")
            me.keep("walks")


@pytest.mark.slow
def test_a_clicked_value_is_the_apis(seat, town):
    me = seat().open(f"?floor={town.floors[1]}")
    me.page.get_by_role("button", name="From above").click()
    me.settled()
    me.page.mouse.move(420, 330)
    expect(me.page.locator("#tip")).to_contain_text("±")
    hovered = me.page.locator("#tip").inner_text()
    me.keep("value")
    me.page.mouse.click(420, 330)
    picked = me.page.locator("#picked")
    expect(picked).to_contain_text("Surveys within 1 m")
    text = picked.inner_text().replace("−", "-")
    x, y = (float(v) for v in re.search(r"x (-?[\d.]+) m, y (-?[\d.]+) m", text).groups())
    assert f"x {x:.2f} m, y {y:.2f} m" in hovered.replace("−", "-")
    query = {"points_m": [[x, y, 0.0]]}
    answer = town.api.post(f"/v1/maps/{town.map_of(1)}/field", json=query).json()
    for name, mean, sd in zip(("Bx", "By", "Bz"), answer["mean_ut"][0], answer["sd_ut"][0], strict=True):
        told_mean, told_sd = (float(v) for v in re.search(rf"{name}\s+(-?[\d.]+) ± ([\d.]+)", text).groups())
        assert told_mean == pytest.approx(mean, abs=0.35)  # the page rounds the place to a centimetre
        assert told_sd == pytest.approx(sd, abs=0.05)
    me.page.locator("#place-x").fill(f"{x:.2f}")
    me.page.locator("#place-y").fill(f"{y:.2f}")
    me.page.get_by_role("button", name="Read").click()
    norm = math.hypot(*answer["mean_ut"][0])
    expect(picked).to_contain_text(f"{norm:.2f} µT")
    me.page.locator("#place-x").fill("999")
    me.page.get_by_role("button", name="Read").click()
    expect(picked).to_contain_text("not measured")


@pytest.mark.slow
def test_a_dropped_window_is_located_with_its_likelihood(seat, town):
    question = next(q for q in town.world.questions if q.floor == 0 and q.length_m == 2.0)
    me = seat().open(f"?floor={town.floors[0]}")
    before = me.settled()
    me.tab("Positions")
    me.drop("#window-drop", "window.json", json.dumps(question.body).encode())
    answer = me.page.locator("#answer")
    expect(answer).to_contain_text("ML", timeout=60_000)
    fix = town.api.post(f"/v1/floors/{town.floors[0]}/locate", json=question.body).json()
    x, y = fix["posterior"]["position_m"][:2]
    expect(answer).to_contain_text(f"x {x:.2f} m, y {y:.2f} m")
    expect(answer).to_contain_text(fix["status"])
    expect(me.page.locator("#legend")).to_contain_text("Log-likelihood")
    after = me.settled()
    assert (before != after).any(axis=-1).mean() > 0.05
    me.keep("position")
    me.page.get_by_role("button", name="Clear").click()
    expect(me.page.locator("#legend")).not_to_contain_text("Log-likelihood")
    me.page.get_by_label("Paste a window").fill("{not json")
    me.page.get_by_role("button", name="Locate").click()
    expect(answer.get_by_role("alert")).to_contain_text("not JSON")
    me.page.get_by_label("Paste a window").fill('{"frame": "level", "b_ut": [[1, 2]], "displacement_m": [[0, 0, 0]]}')
    me.page.get_by_role("button", name="Locate").click()
    expect(answer.get_by_role("alert")).to_contain_text("b_ut")


@pytest.mark.slow
def test_a_walk_is_replayed_against_its_truth(seat, town):
    lines = gzip.decompress(town.world.floors[0].surveys[0].gzipped).decode().splitlines(keepends=True)
    me = seat().open(f"?floor={town.floors[0]}")
    me.page.get_by_role("button", name="From above").click()
    me.tab("Positions")
    me.drop("#walk-drop", "walk.csv", "".join(lines[:1200]).encode())
    expect(me.page.locator("#replay table")).to_be_visible(timeout=120_000)
    said = me.page.locator("#replay").inner_text()
    located, fixes = (int(re.search(rf"{name}\s+(\d+)", said).group(1)) for name in ("located", "a fix"))
    assert located >= 10
    assert fixes >= 0.8 * located
    assert float(re.search(r"median error of fixes\s+([\d.]+) m", said).group(1)) < 1.0
    me.settled()
    me.keep("replay")
    slider = me.page.get_by_label("Along the walk")
    slider.focus()
    last = me.page.locator("#replay-out").inner_text()
    slider.press("Home")
    expect(me.page.locator("#replay-out")).to_contain_text(f"1 of {located}")
    assert me.page.locator("#replay-out").inner_text() != last
    me.drop("#walk-drop", "walk.csv", b"t_s,x_m\n1,2\n")
    expect(me.page.locator("#replay").get_by_role("alert")).to_be_visible()


@pytest.mark.slow
def test_two_people_do_not_move_each_other(seat, town):
    mine, yours = seat().open(f"?floor={town.floors[0]}"), seat().open(f"?floor={town.floors[0]}")
    before = mine.settled()
    yours.choose_floor(1)
    yours.page.get_by_label("Layer").select_option("gradient")
    yours.page.get_by_role("button", name="From above").click()
    yours.settled()
    assert (mine.settled() != before).any(axis=-1).mean() < 1e-3
    yours.page.context.close()
    mine.page.get_by_label("Layer").select_option("sd")
    assert (mine.settled() != before).any(axis=-1).mean() > 0.05


def test_another_organisations_link_shows_nothing_of_theirs(seat, town):
    me = seat()
    me.sign_in(f"?floor={town.floors[0]}&map={town.map_of(0)}", key=town.other_key)
    expect(me.page.locator("#notes")).to_contain_text("not your organisation's")
    expect(me.page.locator("#notes")).to_contain_text("no buildings yet")
    assert town.world.building not in me.page.content()
    assert me.page.locator("#building option").count() == 0


def test_a_key_that_may_only_read_cannot_change_anything(seat, town):
    me = seat().open(f"?floor={town.floors[0]}", key=town.reader_key)
    me.tab("Surveys")
    expect(me.page.locator("#survey-drop")).to_contain_text("may not upload")
    expect(me.page.locator("#survey-list input").first).to_be_disabled()
    me.tab("Maps")
    expect(me.page.get_by_role("button", name="Build a map now")).to_be_disabled()
    me.tab("Positions")
    expect(me.page.get_by_role("button", name="Locate")).to_be_disabled()


@pytest.mark.slow
def test_a_link_shows_the_same_to_somebody_else(seat, town):
    me = seat().open(f"?floor={town.floors[1]}&layer=sd")
    me.page.get_by_role("button", name="From above").click()
    me.page.mouse.move(450, 360)
    me.page.mouse.wheel(0, -600)
    me.page.mouse.move(900, 300)  # off the canvas, so that nothing is said about a place
    seen = me.settled()
    me.page.get_by_role("button", name="Copy link").click()
    expect(me.page.locator("#notes")).to_contain_text("link")
    link = me.page.url.partition("/view/")[2]
    assert "camera=" in link
    you = seat().open(link)
    theirs = you.settled()
    rows = slice(60, 480)  # without buttons and legend
    assert (np.abs(seen[rows].astype(int) - theirs[rows]).max(axis=-1) > 40).mean() < 0.02


def test_all_of_it_works_by_keyboard(seat, town):
    me = seat().open()
    page = me.page
    page.locator("body").press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    reached = set()
    for _ in range(60):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.id || document.activeElement.textContent"))
    assert {"building", "floor", "tab-field", "layer", "arrows", "walks", "outline", "place-x", "place-y"} <= reached
    page.get_by_role("tab", name="Field").focus()
    page.keyboard.press("ArrowRight")
    expect(page.get_by_role("tab", name="Positions")).to_be_focused()
    expect(page.get_by_role("tabpanel")).to_have_attribute("id", "positions")
    page.keyboard.press("ArrowLeft")
    page.get_by_label("Layer").focus()
    page.keyboard.press("ArrowDown")
    expect(page.locator("#legend .legend-of").first).to_contain_text("Component Bx")
    unnamed = page.locator("button, input, select, textarea").evaluate_all(
        "(all) => all.filter((e) => !(e.labels?.length || e.textContent.trim() || e.ariaLabel)).map((e) => e.outerHTML)"
    )
    assert unnamed == []


@pytest.mark.parametrize(("width", "height"), [(1280, 720), pytest.param(820, 1180, marks=pytest.mark.slow)])
def test_it_fits_a_small_screen_and_a_tablet(seat, town, width, height):
    me = seat(width=width, height=height).open(f"?floor={town.floors[0]}")
    picture = me.settled()
    assert colourful_share(picture) > 0.08
    overflow = "document.documentElement.scrollWidth - document.documentElement.clientWidth"
    for name in ("Field", "Positions", "Tracks", "Surveys", "Maps"):
        me.tab(name)
        assert me.page.evaluate(overflow) == 0
        panel = me.page.locator("#panel").evaluate("(e) => e.scrollWidth - e.clientWidth")
        assert panel == 0, name
    if height > width:
        me.tab("Field")
        me.keep("tablet")


@pytest.mark.slow
def test_a_floor_plan_is_laid_under_the_map(seat, town, tmp_path):
    plan = tmp_path / "plan.png"
    picture = np.full((160, 240, 3), 255, np.uint8)
    picture[::20], picture[:, ::20] = (200, 40, 40), (200, 40, 40)
    Image.fromarray(picture).save(plan)
    me = seat().open(f"?floor={town.floors[1]}")
    before = me.settled()
    me.page.get_by_text("Put a floor plan").click()
    me.page.locator("#plan-file").set_input_files(plan)
    me.page.locator("#plan-scale").fill("0.12")
    me.page.locator("#plan-x").fill("-2.4")
    me.page.locator("#plan-y").fill("-1.6")
    me.page.get_by_role("button", name="Upload plan").click()
    expect(me.page.locator("#plan-told")).to_contain_text("under the map now")
    shown = me.settled()
    assert (before != shown).any(axis=-1).mean() > 0.02
    me.page.get_by_label("Floor plan", exact=True).uncheck()
    me.page.wait_for_timeout(500)
    assert (me.settled() != before).any(axis=-1).mean() < 5e-3
    me.page.get_by_role("button", name="Remove plan").click()
    expect(me.page.locator("#plan-told")).to_contain_text("removed")
    assert town.api.get(f"/v1/floors/{town.floors[1]}").json()["plan"] is None


@pytest.mark.slow
def test_a_session_that_ends_leads_back_to_signing_in(seat, town):
    me = seat().open()
    cookie = me.page.context.cookies()[0]
    headers = {"Cookie": f"{cookie['name']}={cookie['value']}", "Origin": town.url}
    town.api.post("/view/sign-out", headers=headers)
    me.page.get_by_label("Layer").select_option("gradient")
    me.page.get_by_label("API key").wait_for()


def test_the_contract_is_shown_without_a_network_and_within_its_policy(town, browser):
    page = browser.new_page()
    said = []
    elsewhere = []
    page.on("console", lambda message: said.append(message.text))
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("request", lambda request: elsewhere.append(request.url) if not request.url.startswith(town.url) else None)
    page.goto(f"{town.url}/docs")
    page.get_by_text("Locate a window anywhere in a building").first.wait_for(timeout=60_000)
    page.get_by_text("Locate a window anywhere in a building").first.click()
    page.get_by_role("button", name="Try it out").first.wait_for(timeout=60_000)
    assert [each for each in elsewhere if not each.startswith(("data:", "blob:"))] == []
    assert [each for each in said if "Content Security Policy" in each or "Refused" in each] == []
    page.close()


def test_the_pages_of_the_viewer_keep_to_their_policy(town, browser):
    page = browser.new_page()
    said = []
    page.on("console", lambda message: said.append(message.text))
    page.goto(f"{town.url}/view/")
    page.get_by_label("API key").or_(page.locator("input[name=key]")).first.fill(town.key)
    page.keyboard.press("Enter")
    page.wait_for_url(f"{town.url}/view/**")
    page.locator("iframe").first.wait_for(timeout=60_000)
    page.wait_for_timeout(2000)
    assert [each for each in said if "Content Security Policy" in each or "Content-Security-Policy" in each] == []
    page.close()
