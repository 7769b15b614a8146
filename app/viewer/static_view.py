"""A map as one self-contained HTML file: no server, no network. viser draws the scene, a panel of ours steers it.

The panel's scripts and style are in `static/`. They reach the scene through what viser 1.1 leaves on `window` for its
own tests (`assets/static/viser.js`); where that is missing, |B| is shown and the layers are in viser's scene tree.
"""

import json
from collections.abc import Sequence
from html import escape
from importlib.resources import files

import numpy as np

from app.field.grid import FieldGrid
from app.geometry import Array
from app.viewer.layers import (
    LAYERS,
    NONE_STORED,
    ColourScale,
    StoredLayers,
    colour_scale,
    layer_names,
    layer_values,
)
from app.viewer.scene import ground_cell_m
from app.viewer.source import Walk
from app.viewer.static_panel import panel_html, radio_label
from app.viewer.static_scene import DrawnScene, draw_static_scene
from app.viewer.static_values import LayerPictures, packed_values, thinned_grid

__all__ = ["PAGE_POLICY", "static_view_html"]

# The file holds everything it needs; this makes the browser refuse anything else.
PAGE_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; connect-src data: blob:; worker-src blob: data:"
)
_SCRIPTS = ("viser.js", "readout.js", "panel.js")


def static_view_html(
    grid: FieldGrid,
    walks: Sequence[Walk] = (),
    title: str = "Magnetic map",
    rings_m: Sequence[Array] = (),
    elevation_m: float | None = None,
    height_index: int = 0,
    stored: StoredLayers = NONE_STORED,
) -> str:
    """One HTML file of a map: every layer at every height, field arrows, walks, outline, legends and values.

    |B| at `height_index`, arrows and walks (unless they would hide the field) are shown at first.
    `rings_m`: outline of the floor, each (k, 2), drawn at `elevation_m` (the map's lowest height when None); `stored`:
    layers of the fit, (nz, ny, nx) each. A map of very many cells is thinned, and the page says so.
    """
    shown_grid, every = thinned_grid(grid)
    layers, scales = _layers(grid, stored, every)
    slab_m = float(grid.heights_m[0]) if elevation_m is None else elevation_m
    scene = draw_static_scene(grid, shown_grid, layers, scales, walks, rings_m, slab_m, height_index)
    panel = panel_html(
        title,
        {name: layer.values for name, layer in layers.items()},
        scales,
        [float(z) for z in grid.heights_m],
        list(scene.extras),
        scene.shown,
        _facts(grid, len(walks), every),
        height_index,
    )
    data = _data(grid, shown_grid, layers, scene, rings_m, slab_m, height_index)
    return _assemble(scene.html, title, panel, data)


def _layers(
    grid: FieldGrid, stored: StoredLayers, every: int
) -> tuple[dict[str, LayerPictures], dict[str, ColourScale]]:
    """Every layer the map has, of every n-th cell, with one colour scale for all heights."""
    layers, scales = {}, {}
    for name in layer_names(grid.components, stored):
        values = [layer_values(grid, name, k, stored) for k in range(len(grid.heights_m))]
        scales[name] = colour_scale(name, values)
        cells = np.stack([v[::every, ::every] for v in values])
        layers[name] = LayerPictures(cells, scales[name].low, scales[name].high)
    return layers, scales


def _facts(grid: FieldGrid, walks: int, every: int) -> dict[str, str]:
    facts = {
        "Measured": _measured(grid),
        "Survey walks": str(walks),
        "Cells": f"{grid.resolution_m:g} m",
        "Ground squares": f"{ground_cell_m([grid]):g} m",
    }
    if every > 1:
        facts["Shown"] = f"one cell in {every} along each side, to keep this file small"
    return facts


def _measured(grid: FieldGrid) -> str:
    areas_m2 = np.count_nonzero(grid.measured, axis=(1, 2)) * grid.resolution_m**2
    if len(areas_m2) > 1 and np.ptp(areas_m2) < 0.5:
        return f"{areas_m2[0]:,.0f} m² at each of {len(areas_m2)} heights"
    return ", ".join(f"{area:,.0f} m² at {z:.2f} m height" for area, z in zip(areas_m2, grid.heights_m, strict=True))


def _data(
    grid: FieldGrid,
    shown_grid: FieldGrid,
    layers: dict[str, LayerPictures],
    scene: DrawnScene,
    rings_m: Sequence[Array],
    slab_m: float,
    height_index: int,
) -> dict[str, object]:
    """What the page's scripts need, as JSON has it."""
    return {
        "heights_m": grid.heights_m.tolist(),
        "height": height_index,
        "origin_m": [float(v) for v in grid.origin_m],
        "resolution_m": shown_grid.resolution_m,
        "shape": list(shown_grid.measured.shape[1:]),
        "components": list(grid.component_names),
        "local_origin_m": scene.local_origin_m.tolist(),
        "box_m": _box_m(grid, rings_m, slab_m, scene.local_origin_m),
        "layers": {name: {"label": radio_label(name), "unit": LAYERS[name].unit} for name in layers},
        "pictures": scene.pictures,
        "extras": scene.extras,
        "values": packed_values(shown_grid, layers),
    }


def _box_m(grid: FieldGrid, rings_m: Sequence[Array], slab_m: float, local_origin_m: Array) -> list[list[float]]:
    """Corners (2, 3) of all that should be in view, local metres."""
    x0, y0, z0, x1, y1, z1 = grid.bounds_m
    half = grid.resolution_m / 2
    points = [np.array([[x0 - half, y0 - half, min(z0, slab_m)], [x1 + half, y1 + half, z1]])]
    points += [np.column_stack([ring[:, :2], np.full(len(ring), slab_m)]) for ring in rings_m if len(ring)]
    every = np.concatenate(points) - local_origin_m
    return [every.min(axis=0).tolist(), every.max(axis=0).tolist()]


def _assemble(page: str, title: str, panel: str, data: dict[str, object]) -> str:
    """viser's page with our title, a policy that forbids the network, the panel and its scripts."""
    folder = files("app.viewer") / "assets" / "static"
    style, *scripts = ((folder / name).read_text(encoding="utf-8") for name in ("view.css", *_SCRIPTS))
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{PAGE_POLICY}" />'
        f"<style>{style}</style><title>{escape(title)} · Isodyn</title>"
    )
    told = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    program = "\n".join(('(() => {\n"use strict";', *scripts, "})();"))
    tail = f'<script type="application/json" id="isodyn-data">{told}</script><script>{program}</script>'
    assert "<title>Viser</title>" in page, "viser's page has changed its head"
    assert '<div id="root"></div>' in page, "viser's page has changed its body"
    page = page.replace("<title>Viser</title>", "", 1).replace("<head>", f"<head>{head}", 1)
    return page.replace('<div id="root"></div>', f'<div id="root"></div>{panel}{tail}', 1)
