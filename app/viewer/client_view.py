"""What one connected browser sees and steers: its own scene and its own controls, never another's.

Everything here lives in the client's scope of viser, so two people looking at the same building do not move each
other, and nothing of an organisation is in the server's shared scene.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from app.errors import IsodynError
from app.field.grid import FieldGrid
from app.viewer import scene as draw
from app.viewer.floor_scene import DrawnFloor, ShownFloor, describe_floors, draw_floor, shared_scales
from app.viewer.layers import LAYERS, layer_names, legend_html
from app.viewer.source import ViewedBuilding, ViewedFloor, Walk

if TYPE_CHECKING:
    from viser import ClientHandle, GuiEvent

    from app.viewer.content import OrganisationContent

__all__ = ["ClientView", "Link"]

_ALL_FLOORS = "All floors"


@dataclass(frozen=True, slots=True)
class Link:
    """What a deep link asks to be shown first; ids that are unknown here are ignored."""

    building_id: str | None = None
    floor_id: str | None = None


class ClientView:
    """Builds the controls of one client, and its scene whenever a control changes. Thread-safe."""

    def __init__(self, client: ClientHandle, content: OrganisationContent, link: Link) -> None:
        self._client = client
        self._content = content
        self._lock = threading.RLock()
        self._buildings = content.buildings()
        self._floors: list[DrawnFloor] = []
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
        self._summary = gui.add_html("")
        with gui.add_folder("Show"):
            shown = {
                "arrows": gui.add_checkbox("Field arrows", True),
                "walks": gui.add_checkbox("Survey walks", True),
                "outline": gui.add_checkbox("Floor outline", True),
            }
            self._spacing = gui.add_slider(
                "Arrow spacing", 0.5, 25.0, 0.25, 1.0, hint="Metres between field arrows; fewer are drawn when needed."
            )
            self._explode = gui.add_slider("Pull apart", 0.0, 40.0, 0.5, 0.0, hint="Metres added between floors.")
        views = gui.add_button_group("View", ["Oblique", "From above"])
        self._shown = shown
        self._building.on_update(lambda event: self._safely(event, self._on_building))
        self._floor.on_update(lambda event: self._safely(event, lambda: self._redraw_when_changed(move_camera=True)))
        for control in (self._layer, self._height, self._spacing):
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

    def _redraw_when_changed(self, move_camera: bool = False) -> None:
        """Redraw unless the choice is the one drawn: events queue up while a slider is dragged."""
        if self._choice() != self._drawn:
            self._redraw(move_camera)

    def _choice(self) -> tuple[object, ...]:
        return tuple(c.value for c in (self._building, self._floor, self._layer, self._height, self._spacing))

    def _spacing_m(self) -> float:
        return float(np.clip(np.nan_to_num(self._spacing.value), 0.1, 100.0))

    def _separation_m(self) -> float:
        return float(np.clip(np.nan_to_num(self._explode.value), 0.0, 100.0))

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
        shown = [ShownFloor.of(f, self._walks[f.id], grids.get(f.id), layer, height_index) for f in floors]
        scale, norm_scale = shared_scales(shown, layer)
        rings = [ring for f in floors for ring in f.rings_m]
        walks = [walk for s in shown for walk in s.walks]
        self._origin_m = draw.local_origin_m(self._grids, rings, walks)
        if move_camera and self._grids:
            _assign(self._spacing, draw.suggested_arrow_spacing_m(self._grids))
            _assign(self._shown["walks"], not draw.walks_hide_the_field(walks, self._grids))
            _assign(self._explode, draw.suggested_separation_m(self._grids))
        with self._client.atomic():
            self._client.scene.reset()
            slab_m = min((f.elevation_m for f in floors), default=0.0)
            draw.draw_ground(self._client.scene, "/ground", self._grids, self._origin_m, slab_m - 0.02)
            self._floors = [
                draw_floor(
                    self._client.scene, f"/floor {k}", floor, scale, norm_scale, self._origin_m, self._spacing_m()
                )
                for k, floor in enumerate(shown)
            ]
            self._apply_visibility()
            self._apply_explosion()
        self._drawn = self._choice()
        self._legend.content = f'<div style="padding:0 0.6em">{legend_html(layer, scale)}</div>' if grids else ""
        self._summary.content = describe_floors(shown, layer)
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

    def _apply_visibility(self) -> None:
        for floor in self._floors:
            for kind, node in floor.nodes.items():
                node.visible = bool(self._shown[kind].value)

    def _apply_explosion(self) -> None:
        for rank, floor in enumerate(self._floors):
            floor.frame.position = (0.0, 0.0, rank * self._separation_m())

    def _move_camera(self, top: bool = False) -> None:
        highest_map_m = max((float(grid.heights_m[-1]) for grid in self._grids), default=0.0)
        highest_m = max([highest_map_m, *(floor.elevation_m for floor in self._current_floors())])
        spread_m = self._separation_m() * max(len(self._floors) - 1, 0) + highest_m - highest_map_m
        position, target = draw.camera_pose(self._grids, self._origin_m, top, spread_m)
        camera = self._client.camera
        with self._client.atomic():
            camera.position = position
            camera.look_at = target


def _assign(control: Any, value: object) -> None:
    """Set a control's value, which viser's own types declare read-only."""
    control.value = value


def _distinct(names: list[str]) -> list[str]:
    """The names with a number where one occurs again: a dropdown tells its options apart by their text."""
    result: list[str] = []
    for name in names:
        candidate, number = name, 1
        while candidate in (*result, _ALL_FLOORS):
            number += 1
            candidate = f"{name} ({number})"
        result.append(candidate)
    return result
