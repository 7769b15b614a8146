"""From what a page asks to what there is: the organisation's own building, floors, maps, layer and height."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from app.errors import InvalidInput, NotFound
from app.viewer.asked import Shown
from app.viewer.floor_scene import ShownFloor
from app.viewer.layers import LAYERS
from app.viewer.picture import OfferedLayer, offered_layers
from app.viewer.scene import walks_hide_the_field
from app.viewer.source import ViewedBuilding, ViewedFloor, Walk

if TYPE_CHECKING:
    from app.viewer.content import OrganisationContent

__all__ = ["Chosen", "choose"]


@dataclass(frozen=True, slots=True)
class Chosen:
    """What is to be drawn.

    layer, layers      the one shown, and those every shown map has
    height_m, heights_m  of the map with the most heights; None without a map
    notes              what was asked for and is not shown, and why
    walks              whether the walks are drawn
    """

    building_id: str | None
    floor_id: str | None
    floors: tuple[ShownFloor, ...]
    layer: str
    layers: list[OfferedLayer]
    height_m: float | None
    heights_m: tuple[float, ...]
    notes: tuple[str, ...]
    walks: bool

    @property
    def stage(self) -> tuple[object, ...]:
        """What the scene is built around: when it changes, all of it is drawn anew."""
        return tuple(
            (
                f.floor.id,
                f.floor.name,
                f.floor.elevation_m,
                f.floor.plan,
                f.map_id,
                f.grid is None,
                *(ring.tobytes() for ring in f.floor.rings_m),
            )
            for f in self.floors
        )


def choose(content: OrganisationContent, asked: Shown) -> Chosen:
    """The floors with their maps. Raises InvalidInput for a layer that the maps do not have."""
    notes: list[str] = []
    building, floors = _floors(content.buildings(), asked, notes)
    one = asked.floor_id is not None and len(floors) == 1
    map_ids = [_map_id(content, floor, asked.map_id if one else None, notes) for floor in floors]
    maps = [content.map(map_id) if map_id else None for map_id in map_ids]
    versus = _versus(content, asked, floors[0], notes) if one and map_ids[0] else None
    stored = [frozenset(m.stored) | ({"difference"} if versus else set()) if m else frozenset() for m in maps]
    bare = [ShownFloor(f, [], i, m.grid if m else None) for f, i, m in zip(floors, map_ids, maps, strict=True)]
    layers = offered_layers(bare, stored)
    layer = _layer(asked.layer, layers, notes)
    heights = max((tuple(float(z) for z in m.grid.heights_m) for m in maps if m), key=len, default=())
    height_m = min(
        heights, key=lambda z: abs(z - (heights[0] if asked.height_m is None else asked.height_m)), default=None
    )
    walks = [content.walks(floor.id) for floor in floors]
    with_walks = asked.walks
    if with_walks is None:
        with_walks = not walks_hide_the_field([w for each in walks for w in each], [m.grid for m in maps if m])
    draw = _Drawing(content, layer, height_m if one else None, versus, with_walks)
    shown = tuple(draw.floor(b, each) for b, each in zip(bare, walks, strict=True))
    return Chosen(building.id if building else None, floors[0].id if one else None, shown, layer, layers,
                  height_m, heights, tuple(notes), with_walks)  # fmt: skip


def _floors(
    buildings: list[ViewedBuilding], asked: Shown, notes: list[str]
) -> tuple[ViewedBuilding | None, tuple[ViewedFloor, ...]]:
    """The floor asked for, or every floor of the building asked for, or of the first that has any."""
    for building in buildings:
        for floor in building.floors:
            if floor.id == asked.floor_id:
                return building, (floor,)
    if asked.floor_id is not None:
        notes.append("The floor of this link is not there, or is not your organisation's.")
    chosen = next((b for b in buildings if b.id == asked.building_id), None)
    if chosen is None and asked.building_id is not None:
        notes.append("The building of this link is not there, or is not your organisation's.")
    if not buildings:
        notes.append("There are no buildings yet. Make one with POST /v1/buildings, then survey it.")
    chosen = chosen or next((b for b in buildings if b.floors), buildings[0] if buildings else None)
    return chosen, chosen.floors if chosen else ()


def _map_id(content: OrganisationContent, floor: ViewedFloor, wanted: str | None, notes: list[str]) -> str | None:
    """The map asked for if it is this floor's and ready, else the active one."""
    if wanted is not None and wanted != floor.map_id:
        if _is_map_of(content, wanted, floor):
            return wanted
        notes.append("The map of this link is not a finished map of this floor; the active one is shown.")
    return floor.map_id


def _versus(content: OrganisationContent, asked: Shown, floor: ViewedFloor, notes: list[str]) -> str | None:
    """The map to compare with, when it is a finished map of the floor."""
    if asked.versus_id is None:
        return None
    if _is_map_of(content, asked.versus_id, floor):
        return asked.versus_id
    notes.append("The map to compare with is not a finished map of this floor.")
    return None


def _is_map_of(content: OrganisationContent, map_id: str, floor: ViewedFloor) -> bool:
    try:
        return content.map(map_id).floor_id == floor.id
    except NotFound:
        return False


def _layer(wanted: str, layers: list[OfferedLayer], notes: list[str]) -> str:
    names = [layer.name for layer in layers]
    if wanted in names:
        return wanted
    if wanted not in LAYERS:
        raise InvalidInput(f"there is no layer {wanted!r}; these maps have {', '.join(names)}")
    notes.append(f"These maps have no layer “{LAYERS[wanted].title}”; the magnitude is shown.")
    return "norm"


@dataclass(frozen=True, slots=True)
class _Drawing:
    """What is drawn of every floor."""

    content: OrganisationContent
    layer: str
    height_m: float | None
    versus_id: str | None
    with_walks: bool

    def floor(self, floor: ShownFloor, walks: list[Walk]) -> ShownFloor:
        if floor.grid is None or floor.map_id is None:
            return ShownFloor(floor.floor, walks)
        k = 0 if self.height_m is None else int(np.argmin(np.abs(floor.grid.heights_m - self.height_m)))
        values = self.content.layer(floor.map_id, self.layer, k, self.versus_id)
        residuals_uT = self.content.residuals_uT(floor.map_id, walks) if self.with_walks else ()
        return ShownFloor(floor.floor, walks, floor.map_id, floor.grid, values, k, residuals_uT)
