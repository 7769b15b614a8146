"""One floor in the scene: what is shown of it, its nodes, and the same in words and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from app.field.grid import FieldGrid
from app.geometry import Array
from app.viewer import scene as draw
from app.viewer.layers import LAYERS, ColourScale, colour_scale, layer_values
from app.viewer.source import ViewedFloor, Walk

if TYPE_CHECKING:
    from viser import FrameHandle, SceneApi, SceneNodeHandle

__all__ = ["OUTLINE_RGB", "DrawnFloor", "ShownFloor", "describe_floors", "draw_floor", "shared_scales"]

OUTLINE_RGB = (190, 200, 210)


@dataclass(frozen=True, slots=True, eq=False)
class ShownFloor:
    """A floor with what is drawn of it.

    values: the chosen layer (ny, nx), NaN where unmeasured; None without a map.
    """

    floor: ViewedFloor
    walks: list[Walk]
    grid: FieldGrid | None = None
    values: Array | None = None
    height_index: int = 0

    @classmethod
    def of(
        cls, floor: ViewedFloor, walks: list[Walk], grid: FieldGrid | None, layer: str, height_index: int
    ) -> ShownFloor:
        """A floor with one layer at one height, or at its highest when it has fewer heights."""
        if grid is None:
            return cls(floor, walks)
        k = min(height_index, len(grid.heights_m) - 1)
        return cls(floor, walks, grid, layer_values(grid, layer, k), k)


@dataclass(frozen=True, slots=True, eq=False)
class DrawnFloor:
    """The nodes of a floor: the frame that all of it hangs on, and what can be hidden, by kind."""

    frame: FrameHandle
    nodes: dict[str, SceneNodeHandle] = field(default_factory=dict)


def shared_scales(shown: Sequence[ShownFloor], layer: str) -> tuple[ColourScale, ColourScale]:
    """The colour scales of a layer and of |B| over all floors together, so that floors can be compared."""
    norms = [layer_values(s.grid, "norm", s.height_index) for s in shown if s.grid is not None]
    return colour_scale(layer, [s.values for s in shown if s.values is not None]), colour_scale("norm", norms)


def draw_floor(
    scene: SceneApi,
    name: str,
    shown: ShownFloor,
    scale: ColourScale,
    norm_scale: ColourScale,
    origin_m: Array,
    arrow_spacing_m: float,
) -> DrawnFloor:
    """Put a floor into a scene under `name`: outline, walks, label, the layer and field arrows."""
    drawn = DrawnFloor(scene.add_frame(name, show_axes=False))
    outline = draw.ring_segments(shown.floor.rings_m, shown.floor.elevation_m, origin_m)
    if len(outline):
        drawn.nodes["outline"] = draw.draw_lines(scene, f"{name}/outline", outline, OUTLINE_RGB, 2.0)
    segments, colours = draw.walk_segments(shown.walks, origin_m)
    if len(segments):
        drawn.nodes["walks"] = draw.draw_lines(scene, f"{name}/walks", segments, colours, 2.0)
    label = shown.floor.name if shown.grid is not None else f"{shown.floor.name}: no map yet"
    scene.add_label(f"{name}/label", label, position=_label_position(shown, origin_m), anchor="bottom-right")
    if shown.grid is None or shown.values is None:
        return drawn
    picture = draw.surface(shown.grid, shown.values, scale, origin_m, shown.height_index)
    draw.draw_surface(scene, f"{name}/layer", picture)
    arrows = draw.field_arrows(shown.grid, origin_m, arrow_spacing_m, shown.height_index)
    if len(arrows.ends_m):
        drawn.nodes["arrows"] = draw.draw_arrows(scene, f"{name}/arrows", arrows, norm_scale)
    return drawn


def describe_floors(shown: Sequence[ShownFloor], layer: str) -> str:
    """The picture in words and numbers as HTML, one paragraph a floor.

    Not Markdown: viser reads the pictures that Markdown names from the server's disk, and a floor may have any name.
    """
    lines = [_describe(s, LAYERS[layer].unit) for s in shown]
    grids = [s.grid for s in shown if s.grid is not None]
    lines.append(f"Ground squares are {draw.ground_cell_m(grids):g} m.")
    paragraphs = "".join(f'<p style="margin:0.5em 0">{line}</p>' for line in lines)
    return f'<div style="padding:0 0.6em"><div style="font-size:0.85em">{paragraphs}</div></div>'


def _describe(shown: ShownFloor, unit: str) -> str:
    name = escape(shown.floor.name)
    walks = "1 walk" if len(shown.walks) == 1 else f"{len(shown.walks)} walks"
    if shown.grid is None or shown.values is None or not np.isfinite(shown.values).any():
        return f"<strong>{name}</strong>: no map yet, {walks}"
    low, middle, high = np.nanpercentile(shown.values, [5.0, 50.0, 95.0])
    area_m2 = np.isfinite(shown.values).sum() * shown.grid.resolution_m**2
    return (
        f"<strong>{name}</strong>: median {middle:.3g} {unit}, 90 % from {low:.3g} to {high:.3g}; "
        f"{area_m2:,.0f} m² measured, {walks}"
    )


def _label_position(shown: ShownFloor, origin_m: Array) -> tuple[float, float, float]:
    """The north-west corner of the floor, local metres."""
    x, y = float(origin_m[0]), float(origin_m[1])
    if shown.floor.rings_m:
        ring = shown.floor.rings_m[0]
        x, y = float(ring[:, 0].min()), float(ring[:, 1].max())
    elif shown.grid is not None:
        x, y = shown.grid.bounds_m[0], shown.grid.bounds_m[4]
    return x - float(origin_m[0]), y - float(origin_m[1]), shown.floor.elevation_m - float(origin_m[2])
