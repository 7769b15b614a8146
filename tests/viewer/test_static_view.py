"""The static page: one file that needs nothing else, and says in plain HTML what it shows."""

import json
import re
import zlib
from base64 import b64decode
from dataclasses import replace

import numpy as np
import pytest

from app.viewer.layers import ColourScale, layer_names
from app.viewer.static_panel import legend
from app.viewer.static_values import pack, thinned_grid
from app.viewer.static_view import static_view_html

RING = np.array([[99.5, 39.5], [124.5, 39.5], [124.5, 54.5], [99.5, 54.5]])


def data_of(page: str) -> dict:
    return json.loads(re.search(r'id="isodyn-data">(.*?)</script>', page, re.DOTALL).group(1))


def unpacked(packed: dict, shape: tuple[int, ...]) -> np.ndarray:
    """As the page's own script reads it."""
    codes = np.cumsum(np.frombuffer(zlib.decompress(b64decode(packed["data"])), "<u2"), dtype=np.uint16)
    return np.where(codes == 0, np.nan, packed["low"] + packed["step"] * (codes - 1.0)).reshape(shape)


@pytest.fixture(scope="module")
def page(grid_of, walk_of) -> str:
    return static_view_html(grid_of(), [walk_of("a")], 'Tower <1> "ground"', [RING], 0.0)


def test_it_is_one_file_that_forbids_itself_the_network(page):
    assert page.lower().startswith("<!doctype html>")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page).group(1)
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    assert "'self'" not in policy
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="(?!data:)', page)
    assert len(page) < 3_000_000


def test_title_and_facts_are_there_and_escaped(page):
    assert "<title>Tower &lt;1&gt; &quot;ground&quot; · Isodyn</title>" in page
    assert "<h1>Tower &lt;1&gt;" in page
    assert "213 m² at 1.20 m height" in page
    assert "<dt>Survey walks</dt><dd>1</dd>" in page
    assert "<dt>Ground squares</dt><dd>2 m</dd>" in page


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
def test_every_layer_has_a_radio_a_legend_and_a_row_of_numbers(grid_of, components):
    grid = grid_of(components, heights=2)
    stored = {name: np.ones(grid.measured.shape, np.float32) for name in ("coverage", "conflict")}
    page = static_view_html(grid, height_index=1, stored=stored)
    names = layer_names(components, stored)
    assert set(re.findall(r'name="isodyn-layer" value="(\w+)"', page)) == set(names)
    assert set(re.findall(r'class="isodyn-legend" data-layer="(\w+)"', page)) == set(names)
    bodies = re.findall(r'<tbody data-height="(\d)"( hidden)?>(.*?)</tbody>', page)
    assert [(k, bool(hidden)) for k, hidden, _ in bodies] == [("0", True), ("1", False)]
    assert all(rows.count("<tr>") == len(names) - 1 for *_, rows in bodies)  # "measured" has no median


def test_the_numbers_of_the_table_are_those_of_the_map(grid_of, page):
    grid = grid_of()
    values = grid.mean_uT[0, ..., 2][grid.measured[0]]
    row = re.search(r'<th scope="row">Component Bz</th>(.*?)</tr>', page).group(1)
    told = [float(cell.replace("−", "-")) for cell in re.findall("<td>([^<µ]+)</td>", row)]
    np.testing.assert_allclose(told, np.percentile(values, [50, 5, 95]), atol=0.06)


def test_the_values_in_the_page_are_those_of_the_map(grid_of):
    grid = grid_of(heights=2)
    data = data_of(static_view_html(grid))
    for k in range(2):
        for c in range(3):
            mean, sd = (unpacked(data["values"][k][what][c], data["shape"]) for what in ("mean", "sd"))
            np.testing.assert_array_equal(np.isfinite(mean), grid.measured[k])
            np.testing.assert_allclose(mean[grid.measured[k]], grid.mean_uT[k, ..., c][grid.measured[k]], atol=0.006)
            np.testing.assert_allclose(sd[grid.measured[k]], grid.sd_uT[k, ..., c][grid.measured[k]], atol=0.006)


def test_a_value_far_above_all_others_costs_the_others_little():
    values = np.linspace(0.0, 1.0, 5000).reshape(50, 100)
    values[3, 4], values[7, 7] = 1e9, np.nan
    read = unpacked(pack(values, 1e-3), values.shape)
    assert np.isnan(read[7, 7])
    usual = np.isfinite(values) & (values < 2.0)
    assert np.abs(read - values)[usual].max() < 6e-4


def test_a_map_of_nothing_measured_is_a_page_too(grid_of):
    grid = grid_of()
    page = static_view_html(replace(grid, measured=np.zeros_like(grid.measured)))
    assert "0 m² at 1.20 m height" in page
    assert "<td>–</td>" in page


def test_a_very_large_map_is_thinned_and_the_page_says_so(grid_of):
    grid = grid_of(size_m=(150.0, 130.0), heights=2)
    fewer, every = thinned_grid(grid)
    assert every == 2
    assert fewer.resolution_m == 0.5
    np.testing.assert_array_equal(fewer.mean_uT, grid.mean_uT[:, ::2, ::2])
    page = static_view_html(grid)
    assert "one cell in 2 along each side" in page
    assert len(page) < 12_000_000
    assert data_of(page)["resolution_m"] == 0.5


def test_ticks_are_round_and_whole_where_surveys_are_counted():
    assert re.findall(r"<span[^>]*>([^<]+)</span>", legend("bz", ColourScale(-51.3, -28.2)))[0] == "−50"
    coverage = re.findall(r"<span[^>]*>([^<]+)</span>", legend("coverage", ColourScale(0.0, 3.0)))
    assert coverage == ["0", "1", "2", "3"]
    assert "not measured" in legend("measured", ColourScale(0.0, 1.0))
