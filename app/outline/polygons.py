"""A floor's outline: a GeoJSON Polygon or MultiPolygon (RFC 7946), read, checked, and put into building metres.

Whatever cannot be used is refused with a JSON pointer to the ring or position, and the reason. Texts of the caller are
quoted in ASCII.
"""

from collections.abc import Callable, Iterator
from math import isfinite
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.geodesy import Anchor, building_from_wgs84, east_north_up_m
from app.geometry import Array

__all__ = [
    "Outline", "Place", "Polygon", "in_building", "members", "on_earth", "outline_of", "read_lines", "read_polygons",
    "refuse",
]  # fmt: skip

FARTHEST_M = 10_000.0
SMALLEST_M = 0.5
MOST_METRES = 1e6
MOST_POSITIONS = 100_000
DECIMALS = 4  # a tenth of a millimetre

Outline = dict[str, Any]
"""A GeoJSON Polygon, or a MultiPolygon where there are several, in building metres."""

Polygon = list[list[list[float]]]

Place = Callable[[Array, str], Array]
"""The positions of a ring (k, 2), and the JSON pointer to it, to x, y (k, 2) in building metres; may refuse."""


def read_polygons(geometry: object, where: str, place: Place) -> list[Polygon]:
    """The polygons of a GeoJSON Polygon or MultiPolygon at the JSON pointer `where`, in building metres.

    A third coordinate is dropped: the floor says how high it lies. Raises InvalidInput.
    """
    kind = members(geometry, where).get("type")
    if kind not in ("Polygon", "MultiPolygon"):
        refuse(f"{where}/type", f"an outline is a Polygon or a MultiPolygon, this is {_quote(kind)}")
    pointer = f"{where}/coordinates"
    coordinates = _list(members(geometry, where).get("coordinates"), pointer, "polygons or rings", 1)
    if kind == "Polygon":
        return [_polygon(coordinates, pointer, place)]
    return [_polygon(rings, f"{pointer}/{k}", place) for k, rings in enumerate(coordinates)]


def read_lines(geometry: object, where: str, place: Place) -> list[list[list[float]]]:
    """The lines of a GeoJSON LineString or MultiLineString at the JSON pointer `where`, in building metres.

    Raises InvalidInput.
    """
    kind = members(geometry, where).get("type")
    if kind not in ("LineString", "MultiLineString"):
        refuse(f"{where}/type", f"walls are a LineString or a MultiLineString, this is {_quote(kind)}")
    pointer = f"{where}/coordinates"
    coordinates = _list(members(geometry, where).get("coordinates"), pointer, "lines or positions", 1)
    lines = [(coordinates, pointer)]
    if kind == "MultiLineString":
        lines = [
            (_list(line, f"{pointer}/{k}", "positions", 2), f"{pointer}/{k}") for k, line in enumerate(coordinates)
        ]
    return [_line(line, at, place) for line, at in lines]


def outline_of(polygons: list[Polygon], where: str) -> Outline:
    """One outline of polygons in building metres. Raises InvalidInput where it is absurdly large or small."""
    p = np.array([position for rings in polygons for ring in rings for position in ring])
    across_m = float(np.max(np.ptp(p, axis=0)))
    if len(p) > MOST_POSITIONS:
        refuse(where, f"an outline may have {MOST_POSITIONS:,} positions, this one has {len(p):,}; simplify it")
    if across_m > FARTHEST_M:
        refuse(where, f"the outline is {across_m:,.0f} m across, more than {FARTHEST_M:,.0f} m: is it in metres?")
    if across_m < SMALLEST_M:
        reason = f"the outline is {across_m:.2g} m across; of longitudes and latitudes say so: coordinates=wgs84"
        refuse(where, reason)
    if len(polygons) == 1:
        return {"type": "Polygon", "coordinates": polygons[0]}
    return {"type": "MultiPolygon", "coordinates": polygons}


def in_building(p_m: Array, where: str) -> Array:
    """Positions that are building metres already. Raises InvalidInput for those out of range."""
    for k in np.flatnonzero(np.abs(p_m).max(axis=1) > MOST_METRES):
        refuse(f"{where}/{k}", f"building coordinates lie within {MOST_METRES:,.0f} m of the origin")
    return p_m


def on_earth(anchor: Anchor) -> Place:
    """Positions as WGS 84 longitude and latitude in degrees, seen from a building's anchor."""

    def place(lon_lat_deg: Array, where: str) -> Array:
        for k in np.flatnonzero((np.abs(lon_lat_deg) > [180.0, 90.0]).any(axis=1)):
            lon, lat = lon_lat_deg[k]
            reason = f"longitude {lon:g}, latitude {lat:g} is out of range: a position is [longitude, latitude]"
            refuse(f"{where}/{k}", reason)
        for k in np.flatnonzero(_far_off(lon_lat_deg, anchor)):
            refuse(f"{where}/{k}", _why_far_off(lon_lat_deg[k : k + 1, ::-1], anchor))
        return building_from_wgs84(lon_lat_deg, anchor)

    return place


def refuse(where: str, reason: str) -> NoReturn:
    """Raise InvalidInput for what is at the JSON pointer `where`."""
    raise InvalidInput(f"{where}: {reason}", Fault(where, reason))


def members(value: object, where: str) -> dict[str, Any]:
    """The members of a JSON object. Raises InvalidInput for anything else."""
    if not isinstance(value, dict):
        refuse(where, f"a GeoJSON object is expected, this is {_quote(value)}")
    return value


def _far_off(lon_lat_deg: Array, anchor: Anchor) -> NDArray[np.bool_]:
    """Whether positions are too far from the anchor, also through the Earth: its far side is on the anchor's axis."""
    away_m = np.linalg.norm(east_north_up_m(lon_lat_deg, anchor.height_m, anchor), axis=1)
    return np.asarray(away_m > FARTHEST_M)


def _why_far_off(swapped_deg: Array, anchor: Anchor) -> str:
    if np.abs(swapped_deg[0, 1]) <= 90.0 and not _far_off(swapped_deg, anchor)[0]:
        return "far from the building, but near it when swapped: a position is [longitude, latitude]"
    return f"more than {FARTHEST_M / 1000:g} km from the building's anchor: is the anchor right?"


def _polygon(rings: object, where: str, place: Place) -> Polygon:
    return [_ring(ring, f"{where}/{k}", place) for k, ring in enumerate(_list(rings, where, "rings", 1))]


def _ring(ring: object, where: str, place: Place) -> list[list[float]]:
    positions = list(_positions(_list(ring, where, "positions", 4), where))
    if positions[0] != positions[-1]:
        refuse(where, f"the ring is not closed: its last position {positions[-1]} must repeat its first {positions[0]}")
    placed: list[list[float]] = np.round(place(np.array(positions), where), DECIMALS).tolist()
    return placed


def _line(line: list[object], where: str, place: Place) -> list[list[float]]:
    positions = np.array(list(_positions(_list(line, where, "positions", 2), where)))
    placed: list[list[float]] = np.round(place(positions, where), DECIMALS).tolist()
    return placed


def _positions(ring: list[object], where: str) -> Iterator[list[float]]:
    for k, position in enumerate(ring):
        if not isinstance(position, list) or not 2 <= len(position) <= 4:
            refuse(f"{where}/{k}", f"a position is a list of two or three numbers, this is {_quote(position)}")
        for j, value in enumerate(position):
            # Bounded before it is made a float: JSON's integers have no end.
            if isinstance(value, bool) or not isinstance(value, int | float) or not _plain(value):
                refuse(f"{where}/{k}/{j}", f"a finite number is expected, this is {_quote(value)}")
        yield [float(position[0]), float(position[1])]


def _plain(value: float) -> bool:
    return isfinite(value) if isinstance(value, float) else abs(value) < 10**15


def _list(value: object, where: str, of_what: str, fewest: int) -> list[object]:
    if not isinstance(value, list) or len(value) < fewest:
        refuse(where, f"a list of {fewest} or more {of_what} is expected, this is {_quote(value)}")
    return value


def _quote(value: object) -> str:
    told = (
        "nothing" if value is None else ascii(value) if isinstance(value, str | int | float) else type(value).__name__
    )
    return told if len(told) <= 60 else told[:57] + "..."
