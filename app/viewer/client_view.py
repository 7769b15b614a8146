"""What one connected browser sees and steers: its own scene and its own controls, never another's.

Everything here lives in the client's scope of viser, so two people looking at the same building do not move each
other, and nothing of an organisation is in the server's shared scene.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from app.errors import IsodynError
from app.field.grid import FieldGrid
from app.geometry import Array
from app.viewer import scene as draw
from app.viewer.layers import LAYERS, ColourScale, colour_scale, layer_names, layer_values, legend_html
from app.viewer.source import ViewedBuilding, ViewedFloor, Walk

if TYPE_CHECKING:
    from viser import ClientHandle, FrameHandle, GuiEvent

    from app.viewer.content import OrganisationContent

__all__ = ["ClientView", "Link"]

_ALL_FLOORS = "All floors"
_OUTLINE_RGB = (190, 200, 210)


@dataclass(frozen=True, slots=True)
class Link:
    """What a deep link asks to be shown first; ids that are unknown here are ignored."""

    building_id: str | None = None
    floor_id: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _ShownFloor:
    """A floor with what is drawn of it; `values` is the chosen layer, NaN where unmeasured."""

    floor: ViewedFloor
    walks: list[Walk]
    grid: FieldGrid | None = None
    values: Array | None = None
    height_index: int = 0


class ClientView:
    """Builds the controls of one client, and its scene whenever a control changes. Thread-safe."""

    def __init__(self, client: ClientHandle, content: OrganisationContent, link: Link) -> None:
        self._client = client
        self._content = content
        self._lock = threading.RLock()
        self._buildings = content.buildings()
        self._frames: list[FrameHandle] = []
        self._nodes: dict[str, list[Any]] = {"arrows": [], "walks": [], "outline": []}
        self._grids: list[FieldGrid] = []
        self._walks: dict[str, list[Walk]] = {}
        self._drawn: tuple[object, ...] = ()
        self._origin_m = np.zeros(3)
        if not self._buildings:
            client.gui.add_markdown("There are no buildings yet. Make one with `POST /v1/buildings`, then survey it.")
            return
        self._add_controls(link)
        self._choose_building()
        self._choose_linked_floor(link)
        self._redraw(move_camera=True)

    # -- controls ---------------------------------------------------------------------------------------------------

    def _add_controls(self, link: Link) -> None:
        gui = self._client.gui
        names = _distinct([b.name for b in self._buildings])
        linked = next((n for n, b in zip(names, self._buildings, strict=True) if b.id == link.building_id), names[0])
        self._building_names = names
        self._building = gui.add_dropdown("Building", names, initial_value=linked)
        self._floor = gui.add_dropdown("Floor", [_ALL_FLOORS])
        self._layer = gui.add_dropdown("Layer", [LAYERS["norm"].title])
        self._height = gui.add_dropdown("Height", ["lowest"], visible=False)
        self._legend = gui.add_html("")
        self._summary = gui.add_markdown("")
        with gui.add_folder("Show"):
            shown = {
                "arrows": gui.add_checkbox("Field arrows", True),
                "walks": gui.add_checkbox("Survey walks", True),
                "outline": gui.add_checkbox("Floor outline", True),
            }
            self._spacing = gui.add_slider(
                "Arrow spacing", 0.5, 10.0, 0.25, 1.0, hint="Metres between field arrows; fewer are drawn when needed."
            )
            self._explode = gui.add_slider("Pull apart", 0.0, 40.0, 0.5, 0.0, hint="Metres added between floors.")
        views = gui.add_button_group("View", ["Oblique", "From above"])
        self._shown = shown
        self._building.on_update(lambda event: self._safely(event, self._on_building))
        for control in (self._floor, self._layer, self._height, self._spacing):
            control.on_update(lambda event: self._safely(event, self._redraw_when_changed))
        for box in shown.values():
            box.on_update(lambda event: self._safely(event, self._apply_visibility))
        self._explode.on_update(lambda event: self._safely(event, self._apply_explosion))
        views.on_click(lambda event: self._safely(event, lambda: self._move_camera(top=views.value == "From above")))

    def _safely(self, event: GuiEvent[Any], action: Callable[[], None]) -> None:
        """Run a control's action; what goes wrong is told to this client in a sentence.

        viser also calls back for the values this class sets itself; those events name no client and are passed over.
        """
        if event.client is None:
            return
        try:
            with self._lock:
                action()
        except IsodynError as error:
            self._client.add_notification("This cannot be shown", str(error), color="red")

    def _on_building(self) -> None:
        self._choose_building()
        self._redraw(move_camera=True)

    def _redraw_when_changed(self) -> None:
        """Redraw unless the choice is the one drawn: events queue up while a slider is dragged."""
        if self._choice() != self._drawn:
            self._redraw()

    def _choice(self) -> tuple[object, ...]:
        return tuple(c.value for c in (self._building, self._floor, self._layer, self._height, self._spacing))

    def _current_building(self) -> ViewedBuilding:
        """The chosen building: always one of this organisation's, whatever name the browser sends."""
        chosen = zip(self._building_names, self._buildings, strict=True)
        return next((b for name, b in chosen if name == self._building.value), self._buildings[0])

    def _choose_building(self) -> None:
        self._walks = {}
        self._floor_names = _distinct([f.name for f in self._current_building().floors])
        self._floor.options = (_ALL_FLOORS, *self._floor_names)
        _assign(self._floor, _ALL_FLOORS)

    def _choose_linked_floor(self, link: Link) -> None:
        for name, floor in zip(self._floor_names, self._current_building().floors, strict=True):
            if floor.id == link.floor_id:
                _assign(self._floor, name)

    def _current_floors(self) -> list[ViewedFloor]:
        named = zip(self._floor_names, self._current_building().floors, strict=True)
        return [f for name, f in named if self._floor.value in (name, _ALL_FLOORS)]

    # -- the scene --------------------------------------------------------------------------------------------------

    def _redraw(self, move_camera: bool = False) -> None:
        floors = self._current_floors()
        grids = {f.id: self._content.grid(f.map_id) for f in floors if f.map_id is not None}
        for floor in floors:
            if floor.id not in self._walks:
                self._walks[floor.id] = self._content.walks(floor.id)
        self._grids = list(grids.values())
        layer, height_index = self._offer_layers_and_heights()
        shown = [self._shown_floor(f, grids.get(f.id), self._walks[f.id], layer, height_index) for f in floors]
        scale = colour_scale(layer, [s.values for s in shown if s.values is not None])
        norms = [layer_values(s.grid, "norm", s.height_index) for s in shown if s.grid is not None]
        rings = [ring for f in floors for ring in f.rings_m]
        self._origin_m = draw.local_origin_m(self._grids, rings, [w for s in shown for w in s.walks])
        if move_camera and self._grids:
            _assign(self._spacing, max(draw.suggested_arrow_spacing_m(grid) for grid in self._grids))
            _assign(self._explode, draw.suggested_separation_m(self._grids))
        with self._client.atomic():
            self._client.scene.reset()
            self._frames = []
            self._nodes = {kind: [] for kind in self._nodes}
            slab_m = min((f.elevation_m for f in floors), default=0.0)
            draw.draw_ground(self._client.scene, "/ground", self._grids, self._origin_m, slab_m - 0.02)
            for rank, shown_floor in enumerate(shown):
                self._draw_floor(rank, shown_floor, scale, colour_scale("norm", norms))
            self._apply_visibility()
            self._apply_explosion()
        self._drawn = self._choice()
        self._legend.content = f'<div style="padding:0 0.6em">{legend_html(layer, scale)}</div>' if grids else ""
        self._summary.content = self._describe(shown, layer)
        if move_camera:
            self._move_camera()

    def _offer_layers_and_heights(self) -> tuple[str, int]:
        """Offer what every shown map has, and keep the present choice where it is still offered."""
        offered = [
            layer
            for layer in LAYERS
            if layer != "measured" and all(layer in layer_names(grid.components) for grid in self._grids)
        ]
        titles = tuple(LAYERS[layer].title for layer in offered)
        if self._layer.options != titles:
            self._layer.options = titles
        layer = next((name for name in offered if LAYERS[name].title == self._layer.value), "norm")
        most = max(self._grids, key=lambda grid: len(grid.heights_m), default=None)
        heights = ("lowest",) if most is None else tuple(f"{k + 1}: {z:.2f} m" for k, z in enumerate(most.heights_m))
        if self._height.options != heights:
            self._height.options = heights
        self._height.visible = len(heights) > 1
        return layer, heights.index(self._height.value) if self._height.value in heights else 0

    @staticmethod
    def _shown_floor(
        floor: ViewedFloor, grid: FieldGrid | None, walks: list[Walk], layer: str, height_index: int
    ) -> _ShownFloor:
        if grid is None:
            return _ShownFloor(floor, walks)
        k = min(height_index, len(grid.heights_m) - 1)
        return _ShownFloor(floor, walks, grid, layer_values(grid, layer, k), k)

    def _draw_floor(self, rank: int, shown: _ShownFloor, scale: ColourScale, norm_scale: ColourScale) -> None:
        scene, base = self._client.scene, f"/floor {rank}"
        self._frames.append(scene.add_frame(base, show_axes=False))
        outline = draw.ring_segments(shown.floor.rings_m, shown.floor.elevation_m, self._origin_m)
        if len(outline):
            self._nodes["outline"].append(draw.draw_lines(scene, f"{base}/outline", outline, _OUTLINE_RGB, 2.0))
        segments, colours = draw.walk_segments(shown.walks, self._origin_m)
        if len(segments):
            self._nodes["walks"].append(draw.draw_lines(scene, f"{base}/walks", segments, colours, 2.0))
        label = shown.floor.name if shown.grid is not None else f"{shown.floor.name}: no map yet"
        scene.add_label(f"{base}/label", label, position=self._label_position(shown), anchor="bottom-right")
        if shown.grid is None or shown.values is None:
            return
        picture = draw.surface(shown.grid, shown.values, scale, self._origin_m, shown.height_index)
        draw.draw_surface(scene, f"{base}/layer", picture)
        arrows = draw.field_arrows(shown.grid, self._origin_m, float(self._spacing.value), shown.height_index)
        if len(arrows.ends_m):
            self._nodes["arrows"].append(draw.draw_arrows(scene, f"{base}/arrows", arrows, norm_scale))

    def _label_position(self, shown: _ShownFloor) -> tuple[float, float, float]:
        """The north-west corner of the floor, local metres."""
        if shown.floor.rings_m:
            ring = shown.floor.rings_m[0]
            x, y = float(ring[:, 0].min()), float(ring[:, 1].max())
        else:
            grid = shown.grid if shown.grid is not None else next(iter(self._grids), None)
            x, y = (0.0, 0.0) if grid is None else (grid.bounds_m[0], grid.bounds_m[4])
        x0, y0, z0 = self._origin_m
        return float(x - x0), float(y - y0), float(shown.floor.elevation_m - z0)

    def _apply_visibility(self) -> None:
        for kind, nodes in self._nodes.items():
            for node in nodes:
                node.visible = bool(self._shown[kind].value)

    def _apply_explosion(self) -> None:
        for rank, frame in enumerate(self._frames):
            frame.position = (0.0, 0.0, rank * float(self._explode.value))

    def _move_camera(self, top: bool = False) -> None:
        highest_map_m = max((float(grid.heights_m[-1]) for grid in self._grids), default=0.0)
        highest_m = max([highest_map_m, *(floor.elevation_m for floor in self._current_floors())])
        spread_m = float(self._explode.value) * max(len(self._frames) - 1, 0) + highest_m - highest_map_m
        position, target = draw.camera_pose(self._grids, self._origin_m, top, spread_m)
        camera = self._client.camera
        with self._client.atomic():
            camera.position = position
            camera.look_at = target

    def _describe(self, shown: list[_ShownFloor], layer: str) -> str:
        """The picture in words and numbers, one line a floor."""
        unit, lines = LAYERS[layer].unit, []
        for s in shown:
            name = escape(s.floor.name)
            if s.grid is None or s.values is None or not np.isfinite(s.values).any():
                lines.append(f"**{name}** no map yet, {_walks(len(s.walks))}")
                continue
            low, middle, high = np.nanpercentile(s.values, [5.0, 50.0, 95.0])
            area_m2 = np.isfinite(s.values).sum() * s.grid.resolution_m**2
            lines.append(
                f"**{name}** median {middle:.3g} {unit}, 90 % in {low:.3g} to {high:.3g}; "
                f"{area_m2:,.0f} m² measured, {_walks(len(s.walks))}"
            )
        squares = f"Ground squares are {draw.ground_cell_m(self._grids):g} m."
        return "\n\n".join([*lines, squares])


def _assign(control: Any, value: object) -> None:
    """Set a control's value, which viser's own types declare read-only."""
    control.value = value


def _walks(count: int) -> str:
    return f"{count} walk" if count == 1 else f"{count} walks"


def _distinct(names: list[str]) -> list[str]:
    """The names with a number where one occurs again: a dropdown tells its options apart by their text."""
    seen: dict[str, int] = {}
    result = []
    for name in names:
        seen[name] = seen.get(name, 0) + 1
        result.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return result
