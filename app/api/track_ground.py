"""The ground of a track, from GeoJSON: where one can walk, walls, stairs and lifts. Refusals say where the fault is."""

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

from app.api.track_request import ConnectorBody, TrackOptionsBody
from app.outline.polygons import Polygon, in_building, members, read_lines, read_polygons, refuse

__all__ = ["read_ground"]

Shape = TypeVar("Shape")
WIDEST_M, MOST_POSITIONS = 1000.0, 20_000  # of a floor's walls, which the filter keeps in a grid of buckets


def read_ground(options: TrackOptionsBody, outlines: Mapping[str, dict[str, Any] | None]) -> dict[str, Any]:
    """`walkable` polygons and `walls` by floor id, and `connectors`, as they are stored with the track.

    `outlines` are those of the track's floors, by id: where one can walk, unless that is told. Raises InvalidInput.
    """
    floor_ids = list(outlines)
    where = "/body/options"
    if options.walkable is None:
        told = {floor_id: outline for floor_id, outline in outlines.items() if outline is not None}
        walkable = {floor_id: _polygons(outline, floor_id) for floor_id, outline in told.items()}
    else:
        walkable = _by_floor(options.walkable, f"{where}/walkable", floor_ids, _polygons)
    walls = {} if options.walls is None else _by_floor(options.walls, f"{where}/walls", floor_ids, _lines)
    for floor_id in floor_ids:
        _check_size(walkable.get(floor_id, []), walls.get(floor_id, []), f"{where}/walkable")
    joins = [_connector(each, f"{where}/connectors/{k}", floor_ids) for k, each in enumerate(options.connectors)]
    return {"walkable": walkable, "walls": walls, "connectors": joins}


def _by_floor(
    told: dict[str, Any], where: str, floor_ids: list[str], read: Callable[[object, str], Shape]
) -> dict[str, Shape]:
    """One geometry for all floors, or one each by floor id."""
    if "type" in told:
        shape = read(told, where)
        return dict.fromkeys(floor_ids, shape)
    for floor_id in told:
        _check_floor(floor_id, f"{where}/{floor_id[:64]}", floor_ids)
    return {floor_id: read(geometry, f"{where}/{floor_id}") for floor_id, geometry in told.items()}


def _polygons(geometry: object, where: str) -> list[Polygon]:
    return read_polygons(geometry, where, in_building)


def _lines(geometry: object, where: str) -> list[list[list[float]]]:
    return read_lines(geometry, where, in_building)


def _check_size(walkable: list[Polygon], walls: list[list[list[float]]], where: str) -> None:
    positions = [position for line in [*walls, *(ring for rings in walkable for ring in rings)] for position in line]
    if not positions:
        return
    across_m = float(np.max(np.ptp(np.array(positions), axis=0)))
    if across_m > WIDEST_M:
        refuse(where, f"walls and edges of a floor may be {WIDEST_M:,.0f} m across, these are {across_m:,.0f} m: "
               "send the part that is walked")  # fmt: skip
    if len(positions) > MOST_POSITIONS:
        refuse(where, f"walls and edges of a floor may have {MOST_POSITIONS:,} positions, these have "
               f"{len(positions):,}; simplify them")  # fmt: skip


def _connector(body: ConnectorBody, where: str, floor_ids: list[str]) -> dict[str, Any]:
    for k, floor_id in enumerate(body.floor_ids):
        _check_floor(floor_id, f"{where}/floor_ids/{k}", floor_ids)
    polygons = read_polygons(members(body.polygon, f"{where}/polygon"), f"{where}/polygon", in_building)
    return {"kind": body.kind, "floor_ids": body.floor_ids, "polygons": polygons}


def _check_floor(floor_id: str, where: str, floor_ids: list[str]) -> None:
    if floor_id not in floor_ids:
        refuse(where, f"not a floor this track is followed on; those are {', '.join(floor_ids)}")
