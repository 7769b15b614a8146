"""The scene of a static page: a picture per layer and height, arrows, walks, outline and ground, of which some show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from app.field.grid import FieldGrid
from app.geometry import Array
from app.viewer.floor_scene import OUTLINE_RGB
from app.viewer.layers import LAYERS, ColourScale
from app.viewer.scene import (
    camera_pose,
    draw_arrows,
    draw_ground,
    draw_lines,
    draw_surface,
    field_arrows,
    local_origin_m,
    ring_segments,
    suggested_arrow_spacing_m,
    surface,
    walk_segments,
    walks_hide_the_field,
)
from app.viewer.source import Walk
from app.viewer.static_values import LayerPictures
from app.viewer.viser_server import start_viser, stop_viser

if TYPE_CHECKING:
    from viser import ViserServer

__all__ = ["DrawnScene", "draw_static_scene"]

_FIELD_OF_VIEW_RAD = float(np.deg2rad(38.0))  # vertical


@dataclass(frozen=True, slots=True, eq=False)
class DrawnScene:
    """viser's page, and what its nodes are called. local_origin_m (3,): what was subtracted from all coordinates.

    pictures: node per height, by layer; extras: nodes of the things a reader switches ("arrows": one per height);
    shown: which of them are visible at first.
    """

    html: str
    local_origin_m: Array
    pictures: dict[str, list[str]]
    extras: dict[str, list[str]]
    shown: frozenset[str]


def draw_static_scene(
    grid: FieldGrid,
    shown_grid: FieldGrid,
    layers: dict[str, LayerPictures],
    scales: dict[str, ColourScale],
    walks: Sequence[Walk],
    rings_m: Sequence[Array],
    elevation_m: float,
    height_index: int,
) -> DrawnScene:
    """Draw everything into a scene of its own. `shown_grid`: the cells that `layers` has values of."""
    origin = local_origin_m([grid], rings_m, walks)
    server = start_viser()
    try:
        pictures = _draw_pictures(server, shown_grid, layers, scales, origin, height_index)
        extras = _draw_arrows(server, grid, scales["norm"], origin, height_index)
        extras |= _draw_lines(server, grid, walks, rings_m, elevation_m, origin)
        draw_ground(server.scene, "/Ground", [grid], origin, elevation_m - 0.02)
        _place_camera(server, grid, origin)
        page = str(server.scene.as_html(dark_mode=True))
    finally:
        stop_viser(server)
    hidden = {"walks"} if walks_hide_the_field(walks, [grid]) else set()
    return DrawnScene(page, origin, pictures, extras, frozenset(extras) - hidden)


def _place_camera(server: ViserServer, grid: FieldGrid, origin_m: Array) -> None:
    """A longer lens than viser's, from farther away: arrows at the rim of a view from above lean less."""
    position, look_at = camera_pose([grid], origin_m)
    farther = np.tan(server.initial_camera.fov / 2) / np.tan(_FIELD_OF_VIEW_RAD / 2)
    server.initial_camera.fov = _FIELD_OF_VIEW_RAD
    server.initial_camera.position, server.initial_camera.look_at = look_at + farther * (position - look_at), look_at


def _draw_pictures(
    server: ViserServer,
    grid: FieldGrid,
    layers: dict[str, LayerPictures],
    scales: dict[str, ColourScale],
    origin_m: Array,
    height_index: int,
) -> dict[str, list[str]]:
    pictures: dict[str, list[str]] = {}
    for layer, found in layers.items():
        pictures[layer] = [_node_name(LAYERS[layer].title, grid, k) for k in range(len(grid.heights_m))]
        for k, node in enumerate(pictures[layer]):
            picture = surface(grid, found.values[k], scales[layer], origin_m, k)
            draw_surface(server.scene, node, picture, visible=layer == "norm" and k == height_index)
    return pictures


def _draw_arrows(
    server: ViserServer, grid: FieldGrid, scale: ColourScale, origin_m: Array, height_index: int
) -> dict[str, list[str]]:
    nodes = [_node_name("Field arrows", grid, k) for k in range(len(grid.heights_m))]
    drawn = False
    for k, node in enumerate(nodes):
        arrows = field_arrows(grid, origin_m, suggested_arrow_spacing_m([grid], k), k)
        if len(arrows.ends_m):
            draw_arrows(server.scene, node, arrows, scale, visible=k == height_index)
            drawn = True
    return {"arrows": nodes} if drawn else {}


def _draw_lines(
    server: ViserServer,
    grid: FieldGrid,
    walks: Sequence[Walk],
    rings_m: Sequence[Array],
    elevation_m: float,
    origin_m: Array,
) -> dict[str, list[str]]:
    drawn = {}
    segments, colours = walk_segments(walks, origin_m)
    if len(segments):
        hidden = walks_hide_the_field(walks, [grid])
        draw_lines(server.scene, "/Survey walks", segments, colours, 2.0, visible=not hidden)
        drawn["walks"] = ["/Survey walks"]
    outline = ring_segments(rings_m, elevation_m, origin_m)
    if len(outline):
        draw_lines(server.scene, "/Floor outline", outline, OUTLINE_RGB, 2.0)
        drawn["outline"] = ["/Floor outline"]
    return drawn


def _node_name(what: str, grid: FieldGrid, k: int) -> str:
    height = f", {grid.heights_m[k]:.2f} m" if len(grid.heights_m) > 1 else ""
    return f"/{what.replace('/', ' per ')}{height}"
