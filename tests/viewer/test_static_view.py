"""The static page: one file that needs nothing else."""

import re

import numpy as np
import pytest

from app.viewer.static_view import static_view_html


@pytest.fixture(scope="module")
def page(grid_of, walk_of) -> str:
    ring = np.array([[99.5, 39.5], [124.5, 39.5], [124.5, 54.5], [99.5, 54.5]])
    return static_view_html(grid_of(), [walk_of("a")], 'Tower <1> "ground"', [ring], 0.0)


def test_it_is_one_file_that_forbids_itself_the_network(page):
    assert page.lower().startswith("<!doctype html>")
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', page).group(1)
    assert policy.startswith("default-src 'none'")
    assert "http" not in policy
    assert "'self'" not in policy
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="(?!data:)', page)
    assert len(page) < 3_000_000


def test_title_legends_and_numbers_are_there_and_escaped(page):
    assert "<title>Tower &lt;1&gt; &quot;ground&quot; · Isodyn</title>" in page
    assert "<h1>Tower &lt;1&gt;" in page
    for words in ("Magnitude |B|, µT", "Uncertainty (1 sd, all components), µT", "Gradient along the floor, µT/m"):
        assert words in page
    assert "m² measured at 1.20 m height, survey walks: 1" in page


@pytest.mark.parametrize("components", ["level", "norm"])
def test_maps_of_fewer_components_have_one_too(grid_of, components):
    assert "Magnitude |B|" in static_view_html(grid_of(components, heights=2), height_index=1)
