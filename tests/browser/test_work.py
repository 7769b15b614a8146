"""Work on the page that changes the server: surveys dropped and left out, maps built, compared and published."""

import gzip
import re

import pytest
from playwright.sync_api import expect

pytestmark = pytest.mark.browser


@pytest.mark.slow
def test_a_dropped_survey_becomes_part_of_the_map_and_can_be_left_out_again(seat, town):
    floor = town.floors[1]
    lines = gzip.decompress(town.world.floors[1].surveys[0].gzipped).decode().splitlines(keepends=True)
    me = seat().open(f"?floor={floor}")
    first = town.map_of(1)
    before = town.api.get(f"/v1/floors/{floor}/surveys").json()["items"]

    me.tab("Surveys")
    me.drop("#survey-drop", "corridor.csv", "".join(lines[:900]).encode())
    uploads = me.page.locator("#uploads")
    expect(uploads).to_contain_text("received: 899 samples", timeout=60_000)
    uploads.get_by_text("What was read").click()
    expect(uploads.locator("table")).to_contain_text("csv")
    expect(me.page.locator("#survey-list")).to_contain_text("corridor.csv")
    me.tab("Maps")
    expect(me.page.locator("#jobs .badge").first).to_have_text("successful", timeout=120_000)
    expect(me.page.locator("#map-list .item").first).to_contain_text("5 surveys")
    expect(me.page.locator("#map-list .item").first).to_contain_text("shown")
    second = town.map_of(1)
    assert second != first
    me.keep("maps")

    me.page.locator("#map-list .item").filter(has_text="4 surveys").first.get_by_role("button", name="Compare").click()
    expect(me.page.locator("#legend")).to_contain_text("Difference to the other map")
    assert f"versus={first}" in me.page.url
    me.settled()
    me.keep("difference")

    me.tab("Surveys")
    me.page.locator("#survey-list .item").filter(has_text="corridor.csv").get_by_role("checkbox").uncheck()
    expect(me.page.locator("#survey-list, #jobs").first).to_be_attached()
    me.tab("Maps")
    expect(me.page.locator("#jobs .item")).to_have_count(2)
    expect(me.page.locator("#jobs .badge").first).to_have_text("successful", timeout=120_000)
    assert town.map_of(1) not in (first, second)
    left = town.api.get(f"/v1/floors/{floor}/surveys").json()["items"]
    assert [s["included"] for s in left] == [True] * len(before) + [False]

    item = me.page.locator("#map-list .item").filter(has_text="5 surveys").first
    item.get_by_role("button", name="Show").click()
    expect(item).to_contain_text("shown")
    item.get_by_role("button", name="Publish").click()
    expect(me.page.locator("#build-told")).to_contain_text("Published")
    assert town.map_of(1) == second


@pytest.mark.slow
def test_a_bad_survey_is_refused_with_where_and_why(seat, town):
    me = seat().open(f"?floor={town.floors[0]}")
    me.tab("Surveys")
    broken = b"t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n0,1,2,1.2,20,0,-40\n0.1,1,oops,1.2,20,0,-40\n"
    me.drop("#survey-drop", "broken.csv", broken)
    expect(me.page.locator("#uploads").get_by_role("alert")).to_contain_text("line 3")
    me.drop("#survey-drop", "picture.gif", b"GIF89a")
    expect(me.page.locator("#uploads").get_by_role("alert")).to_contain_text("ending")


@pytest.mark.slow
def test_a_map_is_built_on_request_with_its_progress_seen_by_everybody(seat, town):
    me, you = seat().open(f"?floor={town.floors[0]}"), seat().open()
    me.tab("Maps")
    me.page.get_by_role("button", name="Build a map now").click()
    expect(me.page.locator("#jobs .item").first).to_contain_text(re.compile("build of"))
    you.tab("Maps")
    expect(you.page.locator("#jobs .item").first).to_be_visible(timeout=30_000)
    expect(me.page.locator("#jobs .badge").first).to_have_text("successful", timeout=120_000)


@pytest.mark.slow
def test_a_disturbed_stretch_is_told_and_left_out(seat, town):
    """A motor of 30 uT is switched on for some seconds while the survey is walked."""
    floor = town.floors[1]
    lines = gzip.decompress(town.world.floors[1].surveys[1].gzipped).decode().splitlines()
    rows = [[float(value) for value in line.split(",")] for line in lines[1:901]]
    for row in rows[400:480]:
        row[4:7] = [row[4] + 20.0, row[5] - 15.0, row[6] + 17.0]
    data = "\n".join([lines[0], *(",".join(f"{value:.5f}" for value in row) for row in rows)])
    me = seat().open(f"?floor={floor}")
    me.tab("Surveys")
    me.drop("#survey-drop", "motor.csv", data.encode())
    uploads = me.page.locator("#uploads")
    expect(uploads).to_contain_text("The field was disturbed", timeout=60_000)
    expect(uploads).to_contain_text("uT and back")
    uploads.get_by_role("button", name="Leave these stretches out of maps").click()
    expect(uploads).to_contain_text("left out of maps", timeout=30_000)
    survey = next(s for s in town.api.get(f"/v1/floors/{floor}/surveys").json()["items"] if s["name"] == "motor.csv")
    (start, end), *_ = survey["excluded_s"]
    assert start <= rows[400][0]
    assert end >= rows[479][0]
    me.tab("Maps")
    expect(me.page.locator("#jobs .badge").first).to_have_text("successful", timeout=120_000)
