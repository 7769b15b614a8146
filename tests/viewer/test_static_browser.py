"""The static page in a real browser: what a reader chooses is what is seen, said and told, without any network.

These tests fail when a new viser no longer lets its scene be steered as `app/viewer/assets/static/viser.js` does it.
"""

import io
import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from playwright.sync_api import Browser, Page

from app.field.grid import FieldGrid
from app.services.export_map import export_map
from app.viewer.layers import layer_names
from app.viewer.notebook import show_map
from app.viewer.static_view import static_view_html

SCENE_READY = "#isodyn-controls:not([disabled])"
RING = np.array([[99.5, 39.5], [124.5, 39.5], [124.5, 54.5], [99.5, 54.5]])
pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def grid(grid_of) -> FieldGrid:
    return grid_of(heights=2)


@pytest.fixture(scope="module")
def file(grid, walk_of, tmp_path_factory) -> Path:
    rng = np.random.default_rng(1)
    coverage = rng.integers(1, 5, grid.measured.shape).astype(np.float32)
    stored = {"coverage": coverage, "conflict": coverage / 2}
    file = tmp_path_factory.mktemp("static") / "view.html"
    page = static_view_html(grid, [walk_of("a")], "Tower", [RING], 0.0, stored=stored)
    file.write_text(page, encoding="utf-8")
    return file


def open_page(browser: Browser, width: int = 900, height: int = 700) -> Page:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.faults, page.asked = [], []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    return page


@pytest.fixture(scope="module")
def page(browser, file):
    """One page for the tests that leave it as they found it, because a scene takes seconds to appear."""
    page = open_page(browser)
    page.goto(file.as_uri())
    page.wait_for_selector(SCENE_READY, timeout=60_000)
    wait_for_field(page)
    yield page
    assert page.faults == []
    page.close()


def picture(page: Page) -> np.ndarray:
    return imread(io.BytesIO(page.locator("#root canvas").first.screenshot()))[..., :3]


def wait_for_field(page: Page) -> np.ndarray:
    for _ in range(60):
        rgb = picture(page)
        if (np.ptp(rgb, axis=-1) > 0.2).mean() > 0.03:
            return rgb
        page.wait_for_timeout(300)
    pytest.fail(f"no field was drawn; the page reported {page.faults}")


def wait_for_change(page: Page, before: np.ndarray, least_px: int | None = None) -> np.ndarray:
    """The picture once more than `least_px` of it are another colour (None: 0.4 % of it)."""
    for _ in range(40):
        now = picture(page)
        changed = np.abs(now - before).max(axis=-1) > 0.1
        if changed.sum() > (0.004 * changed.size if least_px is None else least_px):
            return now
        page.wait_for_timeout(150)
    pytest.fail("the picture stayed as it was")


def numbers(text: str) -> dict[str, tuple[float, float]]:
    """{"|B|": (mean, sd), ...} of a readout."""
    found = re.findall(r"^(\S+) ([−\d.]+) ± ([\d.]+) µT$", text, re.MULTILINE)
    return {name: (float(mean.replace("−", "-")), float(sd)) for name, mean, sd in found}


def assert_told(text: str, grid: FieldGrid, x_m: float, y_m: float, z_m: float, place_error_m: float = 0.0) -> None:
    """The readout says what the map says, to a digit after the point and what the place is uncertain by."""
    values, told = grid.at(np.array([[x_m, y_m, z_m]])), numbers(text)
    slope = np.linalg.norm(values.gradient_uT_per_m[0], axis=-1) * place_error_m
    for name, mean, sd, d in zip(("Bx", "By", "Bz"), values.mean_uT[0], values.sd_uT[0], slope, strict=True):
        assert told[name] == pytest.approx((mean, sd), abs=0.06 + d)
    norm = np.linalg.norm(values.mean_uT[0])
    norm_sd = np.linalg.norm(values.mean_uT[0] * values.sd_uT[0]) / norm
    assert told["|B|"] == pytest.approx((norm, norm_sd), abs=0.06 + slope.max())


def test_it_opens_without_any_network_and_shows_no_controls_but_its_own(page):
    assert [url for url in page.asked if not url.startswith(("file:", "blob:", "data:"))] == []
    assert page.get_by_text("Magnitude |B|, µT").is_visible()
    assert page.locator("[aria-label$='scene tree']:visible").count() == 0
    assert page.locator("#isodyn-note").is_hidden()


def test_every_layer_changes_the_picture_and_the_legend(page):
    page.locator("input[value=arrows]").uncheck()
    radios = page.locator("input[name=isodyn-layer]")
    values = [radio.get_attribute("value") for radio in radios.all()]
    assert set(values) == set(layer_names("vector", ("coverage", "conflict")))
    legends, before = set(), picture(page)
    for value in [*values[1:], "norm"]:
        page.locator(f"input[name=isodyn-layer][value={value}]").check()
        before = wait_for_change(page, before)
        legend = page.locator(".isodyn-legend:visible")
        assert legend.count() == 1
        assert legend.get_attribute("data-layer") == value
        legends.add(legend.inner_text())
        shown = page.evaluate(
            "Object.values(window.__viserSceneTree.getState())"
            ".filter((n) => n?.message?.type === 'ImageMessage' && n.effectiveVisibility).length"
        )
        assert shown == 1
    assert len(legends) == len(values)
    page.locator("input[value=arrows]").check()


@pytest.mark.parametrize("extra", ["arrows", "walks", "outline"])
def test_arrows_walks_and_outline_come_and_go(page, extra):
    box = page.locator(f"input[type=checkbox][value={extra}]")
    assert box.is_checked()
    before = picture(page)
    box.uncheck()
    after = wait_for_change(page, before, least_px=300)
    box.check()
    wait_for_change(page, after, least_px=300)


def test_a_height_brings_its_own_picture_and_numbers(page, grid):
    before = picture(page)
    page.locator("#isodyn-height").select_option("1")
    wait_for_change(page, before)
    page.get_by_text("Layers as numbers").click()
    shown = page.locator("tbody:visible tr", has_text="Bz").inner_text().split("\t")
    values = grid.mean_uT[1, ..., 2][grid.measured[1]]
    assert float(shown[1].replace("−", "-")) == pytest.approx(np.median(values), abs=0.06)
    page.get_by_text("Layers as numbers").click()
    page.locator("#isodyn-height").select_option("0")


def test_the_views_look_from_where_they_say(page):
    """From above a square of the ground is as wide as it is high, wherever it is."""
    look = "(() => { const c = window.__viserMutable.camera; return [c.position.x, c.position.y, c.position.z]; })()"
    for name, slant in (("From above", 0.01), ("Oblique", 0.6)):
        page.get_by_role("button", name=name).click()
        page.wait_for_timeout(1500)
        right, up, back = page.evaluate(look)  # viser's three.js world has y up and -z northward
        assert np.hypot(right, back) / up == pytest.approx(slant, abs=0.35 if name == "Oblique" else 0.02)


def test_pointing_tells_the_value_of_the_map_at_that_point(page, grid):
    page.get_by_role("button", name="From above").click()
    page.wait_for_timeout(1500)
    box = page.locator("#root canvas").first.bounding_box()
    told = 0
    for across, down in ((0.3, 0.7), (0.55, 0.6), (0.7, 0.65), (0.25, 0.4), (0.8, 0.3), (0.02, 0.02)):
        page.mouse.move(box["x"] + across * box["width"], box["y"] + down * box["height"])
        page.wait_for_timeout(250)
        text = page.locator("#isodyn-readout").inner_text()
        x_m, y_m = map(float, re.match(r"x (-?[\d.]+) m, y (-?[\d.]+) m", text).groups())
        if "not measured" in text:
            nearby = grid.at(np.array([[x_m + dx, y_m + dy, 1.2] for dx in (-0.01, 0.01) for dy in (-0.01, 0.01)]))
            assert not nearby.measured.all()
        else:
            assert_told(text, grid, x_m, y_m, 1.2, place_error_m=0.01)
            told += 1
    assert told >= 3
    page.get_by_role("button", name="Oblique").click()
    page.wait_for_timeout(1500)


def test_the_point_under_the_pointer_is_where_it_looks_to_be(page):
    """The map's own corners, put through the camera and back."""
    for x_m, y_m in ((100.0, 40.0), (124.0, 40.0), (109.0, 54.0)):
        pixel = page.evaluate(
            """([x, y, z]) => {
              const v = window.__viserMutable, box = v.canvas.getBoundingClientRect();
              const p = v.camera.position.clone().set(x, y, z).applyMatrix4(v.nodeRefFromName[""].matrixWorld);
              p.project(v.camera);
              return [box.left + ((p.x + 1) / 2) * box.width, box.top + ((1 - p.y) / 2) * box.height];
            }""",
            [x_m - 112.0, y_m - 47.0, 1.2],
        )
        page.mouse.move(*pixel)
        page.wait_for_timeout(250)
        text = page.locator("#isodyn-readout").inner_text()
        told = [float(v) for v in re.match(r"x (-?[\d.]+) m, y (-?[\d.]+) m", text).groups()]
        assert told == pytest.approx((x_m, y_m), abs=0.1)


def test_a_keyboard_is_enough(page, grid):
    """Tab reaches every control, arrows choose layers, and a typed point is answered."""
    page.locator("#isodyn-collapse").focus()
    reached = []
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate(
                "(() => { const e = document.activeElement; return e.id || e.value || e.dataset.view || e.tagName; })()"
            )
        )
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none"
        if reached[-1] == "isodyn-y":
            break
    assert reached == [
        "isodyn-height",
        "norm",
        "arrows",
        "walks",
        "outline",
        "oblique",
        "above",
        "isodyn-x",
        "isodyn-y",
    ]
    page.locator("#isodyn-x").focus()
    page.keyboard.type("103.37")
    page.keyboard.press("Tab")
    page.keyboard.type("43.1")
    page.wait_for_timeout(300)
    assert_told(page.locator("#isodyn-value").inner_text(), grid, 103.37, 43.1, 1.2)
    before = picture(page)
    page.locator("input[value=norm]").focus()
    page.keyboard.press("ArrowDown")
    before = wait_for_change(page, before)
    assert page.locator(".isodyn-legend:visible").get_attribute("data-layer") == "bx"
    page.keyboard.press("ArrowUp")
    wait_for_change(page, before)
    page.locator("#isodyn-x").fill("200")
    page.wait_for_timeout(200)
    assert page.locator("#isodyn-value").inner_text() == "not measured"


def test_the_value_of_a_layer_is_told_beside_the_field(page, grid):
    page.locator("input[value=gradient]").check()
    page.locator("#isodyn-x").fill("103.0")
    page.locator("#isodyn-y").fill("43.0")
    page.wait_for_timeout(300)
    told = re.search(r"Gradient ([\d.]+) µT/m", page.locator("#isodyn-value").inner_text())
    slopes = grid.at(np.array([[103.0, 43.0, 1.2]])).gradient_uT_per_m[0]
    assert float(told.group(1)) == pytest.approx(np.linalg.norm(slopes[:, :2]), rel=0.02, abs=0.02)
    page.locator("input[value=norm]").check()


def test_the_panel_folds_and_the_scene_takes_its_place(page):
    before = page.locator("#root canvas").first.bounding_box()["width"]
    page.get_by_role("button", name="Hide panel").click()
    page.wait_for_timeout(500)
    assert page.locator("#root canvas").first.bounding_box()["width"] > before + 200
    assert page.get_by_text("Oblique").is_hidden()
    assert page.get_by_text("Magnitude |B|, µT").is_visible()
    page.get_by_role("button", name="Show panel").click()
    page.wait_for_timeout(500)
    assert page.get_by_text("Oblique").is_visible()


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (820, 1180), (390, 844)])
def test_map_and_panel_share_every_screen(page, width, height):
    page.set_viewport_size({"width": width, "height": height})
    page.wait_for_timeout(500)
    canvas, panel = page.locator("#root canvas").first.bounding_box(), page.locator("#isodyn-panel").bounding_box()
    assert canvas["width"] * canvas["height"] > 0.4 * width * height
    beside = canvas["x"] >= panel["x"] + panel["width"] - 1
    assert beside or panel["y"] >= canvas["y"] + canvas["height"] - 1
    assert page.evaluate("document.querySelector('#isodyn-panel').scrollWidth") <= panel["width"] + 1
    page.set_viewport_size({"width": 900, "height": 700})


@pytest.mark.slow
def test_a_tap_reads_a_point_on_a_tablet(browser, file, grid):
    context = browser.new_context(viewport={"width": 820, "height": 1180}, has_touch=True)
    page = context.new_page()
    page.goto(file.as_uri())
    page.wait_for_selector(SCENE_READY, timeout=60_000)
    page.wait_for_timeout(1000)
    box = page.locator("#root canvas").first.bounding_box()
    page.touchscreen.tap(box["x"] + 0.25 * box["width"], box["y"] + 0.55 * box["height"])
    page.locator("#isodyn-readout").wait_for()
    x_m, y_m = (float(page.locator(name).input_value()) for name in ("#isodyn-x", "#isodyn-y"))
    assert_told(page.locator("#isodyn-readout").inner_text(), grid, x_m, y_m, 1.2, place_error_m=0.01)
    context.close()


@pytest.mark.slow
def test_a_scene_that_cannot_be_steered_still_shows_the_field_and_says_where_the_layers_are(browser, file):
    page = open_page(browser)
    page.add_init_script(
        "Object.defineProperty(window, '__viserMutable', {get: () => undefined, set: () => {}, configurable: true})"
    )
    page.goto(file.as_uri())
    wait_for_field(page)
    assert page.get_by_text("Magnitude |B|, µT").is_visible()
    page.locator("#isodyn-note").wait_for(timeout=30_000)
    assert "scene tree" in page.locator("#isodyn-note").inner_text()
    page.get_by_role("button", name="Show scene tree").click()
    page.get_by_text("Component Bz (up), 1.20 m").wait_for()
    assert page.locator("input[value=bx]").is_disabled()
    assert page.faults == []
    page.close()


@pytest.mark.slow
def test_a_notebook_shows_the_page_in_a_frame_of_its_own(browser, grid, tmp_path):
    exported = tmp_path / "tower.npz"
    exported.write_bytes(export_map(grid, "npz", "0" * 64))
    shown = show_map(exported, frame_height_px=500)
    notebook = tmp_path / "notebook.html"
    notebook.write_text(f"<!doctype html><meta charset=utf-8><body>{shown._repr_html_()}", encoding="utf-8")
    page = open_page(browser, 1000, 560)
    page.goto(notebook.as_uri())
    frame = page.frame_locator("iframe")
    frame.locator(SCENE_READY).wait_for(timeout=60_000)
    assert page.locator("iframe").get_attribute("sandbox") == "allow-scripts"
    assert page.locator("iframe").bounding_box()["height"] == 500
    for _ in range(60):
        rgb = imread(io.BytesIO(frame.locator("#root canvas").first.screenshot()))[..., :3]
        if (np.ptp(rgb, axis=-1) > 0.2).mean() > 0.03:
            break
        page.wait_for_timeout(300)
    else:
        pytest.fail("no field was drawn in the frame")
    frame.locator("#isodyn-x").fill("103")
    frame.locator("#isodyn-y").fill("43")
    page.wait_for_timeout(300)
    assert_told(frame.locator("#isodyn-value").inner_text(), grid, 103.0, 43.0, 1.2)
    assert [url for url in page.asked if not url.startswith(("file:", "blob:", "data:", "about:"))] == []
    assert page.faults == []
    assert shown._repr_png_().startswith(b"\x89PNG")
    page.close()
