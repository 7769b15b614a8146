"""A map as one self-contained HTML file: no server, no network, layers switched in the page's own scene tree."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from app.field.grid import FieldGrid
from app.geometry import Array
from app.viewer.floor_scene import OUTLINE_RGB
from app.viewer.layers import LAYERS, ColourScale, colour_scale, layer_names, layer_values, legend_html
from app.viewer.scene import (
    camera_pose,
    draw_arrows,
    draw_ground,
    draw_lines,
    draw_surface,
    field_arrows,
    ground_cell_m,
    local_origin_m,
    ring_segments,
    suggested_arrow_spacing_m,
    surface,
    walk_segments,
    walks_hide_the_field,
)
from app.viewer.source import Walk
from app.viewer.viser_server import start_viser, stop_viser

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["static_view_html"]

_LAYER_GAP_M = 0.004  # so that of two layers switched on the later one covers the other
# The file holds everything it needs; this makes the browser refuse anything else.
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' blob: data:; style-src 'unsafe-inline'; "
    "img-src data: blob:; font-src data:; connect-src data: blob:; worker-src blob: data:"
)
_STYLE = """
.isodyn-legend{position:fixed;left:1rem;bottom:1rem;width:17rem;max-height:80vh;overflow:auto;z-index:10;
  padding:.7rem .9rem;border-radius:.5rem;background:rgba(26,27,30,.88);color:#e9ecef;
  font:14px/1.35 system-ui,sans-serif;box-shadow:0 2px 12px rgba(0,0,0,.35)}
.isodyn-legend h1{font-size:1rem;margin:0 0 .5rem}
.isodyn-legend p{margin:.5rem 0 0;font-size:.8rem;color:#adb5bd}
.isodyn-legend summary{cursor:pointer;font-size:.85rem;margin-top:.6rem}
.isodyn-legend details>div{margin-top:.7rem}
"""


def static_view_html(
    grid: FieldGrid,
    walks: Sequence[Walk] = (),
    title: str = "Magnetic map",
    rings_m: Sequence[Array] = (),
    elevation_m: float | None = None,
    height_index: int = 0,
) -> str:
    """One HTML file of a map at one of its heights: every layer, field arrows, walks, outline and legends.

    |B|, arrows and walks (unless they would hide the field) are shown at first; the rest waits in the scene tree, which
    the button at the top right opens.
    `rings_m`: outline of the floor, drawn at `elevation_m` (the map's own height when None).
    """
    names = [layer for layer in layer_names(grid.components) if layer != "measured"]
    values = {layer: layer_values(grid, layer, height_index) for layer in names}
    scales = {layer: colour_scale(layer, [values[layer]]) for layer in names}
    server = start_viser()
    try:
        origin = local_origin_m([grid], rings_m, walks)
        for rank, layer in enumerate(names):
            above = origin - np.array([0.0, 0.0, rank * _LAYER_GAP_M])
            picture = surface(grid, values[layer], scales[layer], above, height_index)
            draw_surface(server.scene, f"/{_node_name(layer)}", picture, visible=layer == "norm")
        _draw_lines_and_arrows(server, grid, walks, rings_m, elevation_m, origin, scales["norm"], height_index)
        server.initial_camera.position, server.initial_camera.look_at = camera_pose([grid], origin)
        page = str(server.scene.as_html(dark_mode=True))
    finally:
        stop_viser(server)
    return _with_legend(page, title, grid, scales, height_index, len(walks))


def _draw_lines_and_arrows(
    server: ViserServer,
    grid: FieldGrid,
    walks: Sequence[Walk],
    rings_m: Sequence[Array],
    elevation_m: float | None,
    origin_m: Array,
    scale: ColourScale,
    height_index: int,
) -> None:
    arrows = field_arrows(grid, origin_m, suggested_arrow_spacing_m([grid], height_index), height_index)
    if len(arrows.ends_m):
        draw_arrows(server.scene, "/Field arrows", arrows, scale)
    segments, colours = walk_segments(walks, origin_m)
    if len(segments):
        hidden = walks_hide_the_field(walks, [grid])
        draw_lines(server.scene, "/Survey walks", segments, colours, 2.0, visible=not hidden)
    slab = float(grid.heights_m[height_index]) if elevation_m is None else elevation_m
    draw_ground(server.scene, "/Ground", [grid], origin_m, slab - 0.02)
    outline = ring_segments(rings_m, slab, origin_m)
    if len(outline):
        draw_lines(server.scene, "/Floor outline", outline, OUTLINE_RGB, 2.0)


def _node_name(layer: str) -> str:
    return LAYERS[layer].title.replace("/", " per ")


def _with_legend(
    page: str, title: str, grid: FieldGrid, scales: dict[str, ColourScale], height_index: int, walks: int
) -> str:
    """The page with its title, a policy that forbids the network, and the legends as plain HTML over the canvas."""
    measured_m2 = float(np.count_nonzero(grid.measured[height_index])) * grid.resolution_m**2
    others = "".join(f"<div>{legend_html(layer, scale)}</div>" for layer, scale in scales.items() if layer != "norm")
    legend = (
        f'<aside class="isodyn-legend" aria-label="Legend"><h1>{escape(title)}</h1>'
        f"{legend_html('norm', scales['norm'])}"
        f"<details><summary>Other layers</summary>{others}</details>"
        f"<p>{measured_m2:,.0f} m² measured at {grid.heights_m[height_index]:.2f} m height, survey walks: {walks}. "
        f"Ground squares are {ground_cell_m([grid]):g} m. "
        "Switch layers with the button at the top right.</p></aside>"
    )
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}" />'
        f"<style>{_STYLE}</style><title>{escape(title)} · Isodyn</title>"
    )
    assert "<title>Viser</title>" in page, "viser's page has changed its head"
    page = page.replace("<title>Viser</title>", "", 1).replace("<head>", f"<head>{head}", 1)
    return page.replace('<div id="root"></div>', f'<div id="root"></div>{legend}', 1)
