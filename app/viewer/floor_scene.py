"""One floor in the scene: what is shown of it, its nodes, and the same in words and numbers."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from app.field.grid import FieldGrid
from app.geometry import Array
from app.viewer import scene as draw
from app.viewer.asked import Marks
from app.viewer.layers import ColourScale, colour_scale, layer_values
from app.viewer.mark_nodes import MarkNodes
from app.viewer.marks import blend_likelihood, mark_pieces
from app.viewer.source import ViewedFloor, Walk

if TYPE_CHECKING:
    from viser import FrameHandle, SceneApi, SceneNodeHandle

__all__ = ["OUTLINE_RGB", "DrawnFloor", "ShownFloor", "layer_scale", "norm_scale", "residual_scale"]

OUTLINE_RGB = (190, 200, 210)
_UNKNOWN_RGB = (140, 140, 140)
_RESIDUAL_MAP = "YlOrRd"
_DIMMED = 0.4


@dataclass(frozen=True, slots=True, eq=False)
class ShownFloor:
    """A floor with what is drawn of it.

    map_id, grid  of the map that is shown; None without one
    values        the chosen layer (ny, nx), NaN where unmeasured
    residual_uT   of each walk: (n,) length of what it measured less the map, NaN where that is not known
    """

    floor: ViewedFloor
    walks: list[Walk]
    map_id: str | None = None
    grid: FieldGrid | None = None
    values: Array | None = None
    height_index: int = 0
    residual_uT: tuple[Array, ...] = ()

    @property
    def height_m(self) -> float:
        """Where the layer lies, and what is marked on the floor."""
        return self.floor.elevation_m if self.grid is None else float(self.grid.heights_m[self.height_index])


def layer_scale(shown: Sequence[ShownFloor], layer: str) -> ColourScale:
    """The colour scale of a layer over all floors together, so that floors can be compared."""
    return colour_scale(layer, [s.values for s in shown if s.values is not None])


def norm_scale(shown: Sequence[ShownFloor]) -> ColourScale:
    """The same of |B|, whichever layer is shown."""
    return colour_scale("norm", [layer_values(s.grid, "norm", s.height_index) for s in shown if s.grid is not None])


def residual_scale(shown: Sequence[ShownFloor]) -> ColourScale | None:
    """From nothing to the 95th percentile of every walk's residual; None when none is known."""
    known = np.concatenate([np.zeros(0), *(r[np.isfinite(r)] for s in shown for r in s.residual_uT)])
    return ColourScale(0.0, max(float(np.percentile(known, 95.0)), 1e-3), _RESIDUAL_MAP) if len(known) else None


class DrawnFloor:
    """The nodes of a floor under one frame, each drawn anew by itself."""

    def __init__(self, scene: SceneApi, name: str, shown: ShownFloor, origin_m: Array) -> None:
        self.name, self.shown, self.origin_m = name, shown, origin_m
        self._scene = scene
        self.frame: FrameHandle = scene.add_frame(name, show_axes=False)
        self.nodes: dict[str, SceneNodeHandle] = {}
        self._values_drawn: Array | None = None
        self._look_drawn: object = None
        self._residuals_drawn: tuple[Array, ...] | None = None
        self._marked: dict[str, MarkNodes] = {}
        outline = draw.ring_segments(shown.floor.rings_m, shown.floor.elevation_m, origin_m)
        if len(outline):
            self.nodes["outline"] = draw.draw_lines(scene, f"{name}/outline", outline, OUTLINE_RGB, 2.0)
        label = shown.floor.name if shown.grid is not None else f"{shown.floor.name}: no map yet"
        scene.add_label(f"{name}/label", label, position=_label_position(shown, origin_m), anchor="bottom-right")

    def draw_plan(self, picture: NDArray[np.uint8]) -> None:
        """The floor's plan on its slab."""
        floor = self.shown.floor
        assert floor.plan is not None
        name = f"{self.name}/plan"
        self.nodes["plan"] = draw.draw_plan(self._scene, name, picture, floor.plan, floor.elevation_m, self.origin_m)

    def draw_layer(self, shown: ShownFloor, scale: ColourScale, marks: Collection[Marks]) -> None:
        """The chosen layer as a picture in its plane; dimmed under marks, and a likelihood over it."""
        likelihoods = (each.likelihood for each in marks if each.likelihood is not None)
        likelihood = next((each for each in likelihoods if each.floor_id == shown.floor.id), None)
        marked = any(marks)
        look = (scale, marked, likelihood)
        same = shown.values is self._values_drawn and look == self._look_drawn
        self.shown = shown
        if shown.grid is None or shown.values is None or same:
            return
        picture = draw.surface(shown.grid, shown.values, scale, self.origin_m, shown.height_index)
        if marked:
            picture.rgba[..., :3] = np.round(_DIMMED * picture.rgba[..., :3])
        if likelihood is not None:
            blend_likelihood(picture, likelihood, self.origin_m)
        draw.draw_surface(self._scene, f"{self.name}/layer", picture)
        self._values_drawn, self._look_drawn = shown.values, look

    def draw_marks(self, marks: Marks) -> None:
        """What is marked on this floor of one kind, in place of what was."""
        nodes = self._marked.get(marks.of)
        if nodes is None:
            root = f"{self.name}/{'marks' if marks.of == 'answer' else marks.of}"
            nodes = self._marked.setdefault(marks.of, MarkNodes(self._scene, root))
        nodes.draw(mark_pieces(self.shown.floor.id, self.shown.height_m, marks, self.origin_m))

    def draw_walks(self, scale: ColourScale | None) -> None:
        """The walks, in the colours of their residuals; nothing when they are drawn already."""
        if not self.shown.walks or self.shown.residual_uT is self._residuals_drawn:
            return
        colours = None if scale is None else [_residual_rgb(r, scale) for r in self.shown.residual_uT]
        segments, rgb = draw.walk_segments(self.shown.walks, self.origin_m, colours or None)
        self.nodes["walks"] = draw.draw_lines(self._scene, f"{self.name}/walks", segments, rgb, 3.0)
        self._residuals_drawn = self.shown.residual_uT

    def draw_arrows(self, scale: ColourScale, spacing_m: float, box_m: draw.Box, visible: bool) -> int:
        """Field arrows in a part of the floor; returns how many."""
        if self.shown.grid is None:
            return 0
        arrows = draw.field_arrows(self.shown.grid, self.origin_m, spacing_m, self.shown.height_index, box_m)
        name = f"{self.name}/arrows"
        self._scene.remove_by_name(name)
        self.nodes.pop("arrows", None)
        if len(arrows.ends_m):
            self.nodes["arrows"] = draw.draw_arrows(self._scene, name, arrows, scale, visible)
        return len(arrows.ends_m)


def _residual_rgb(residual_uT: Array, scale: ColourScale) -> NDArray[np.uint8]:
    known = np.isfinite(residual_uT)[:, None]
    return np.where(known, scale.rgb(residual_uT), np.array(_UNKNOWN_RGB, dtype=np.uint8)).astype(np.uint8)


def _label_position(shown: ShownFloor, origin_m: Array) -> tuple[float, float, float]:
    """The north-west corner of the floor, local metres."""
    x, y = float(origin_m[0]), float(origin_m[1])
    if shown.floor.rings_m:
        ring = shown.floor.rings_m[0]
        x, y = float(ring[:, 0].min()), float(ring[:, 1].max())
    elif shown.grid is not None:
        x, y = shown.grid.bounds_m[0], shown.grid.bounds_m[4]
    return x - float(origin_m[0]), y - float(origin_m[1]), shown.floor.elevation_m - float(origin_m[2])
