"""Outlines from GeoJSON and IMDF: what is read, and where and why the rest is refused."""

import json
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import InvalidInput
from app.geodesy import Anchor
from app.outline.levels import read_levels, read_outline
from app.outline.polygons import in_building, on_earth, outline_of, read_polygons

SQUARE = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]
HOLE = [[2.0, 2.0], [4.0, 2.0], [4.0, 4.0], [2.0, 2.0]]
ANCHOR = Anchor(48.14, 11.56, 520.0, 90.0)


def polygon(*rings: Any) -> dict[str, Any]:
    return {"type": "Polygon", "coordinates": list(rings)}


def shifted(ring: list[list[float]], by: float) -> list[list[float]]:
    return [[x + by, y] for x, y in ring]


def level(ordinal: object, geometry: Any = None, **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "feature_type": "level",
        "properties": {"ordinal": ordinal, "name": {"en": f"L{ordinal}"}} | properties,
        "geometry": geometry or polygon(SQUARE),
    }


def collection(*features: Any) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": list(features)}


def refusal(geojson: Any, place: Any = in_building) -> tuple[str, str]:
    with pytest.raises(InvalidInput) as caught:
        read_outline(geojson, "/body", place, 0)
    (fault,) = caught.value.faults
    str(caught.value).encode()
    return fault.location, fault.reason


def test_polygons_keep_their_holes_and_lose_their_heights() -> None:
    high = [[x, y, 7.0] for x, y in SQUARE]
    assert read_outline(polygon(high, HOLE), "", in_building, 0) == polygon(SQUARE, HOLE)
    feature = {"type": "Feature", "properties": None, "geometry": polygon(SQUARE)}
    assert read_outline(feature, "", in_building, 5) == polygon(SQUARE)


def test_several_polygons_are_a_multipolygon_and_one_is_not() -> None:
    two = {"type": "MultiPolygon", "coordinates": [[SQUARE, HOLE], [shifted(SQUARE, 20)]]}
    assert read_outline(two, "", in_building, 0) == two
    assert read_outline({"type": "MultiPolygon", "coordinates": [[SQUARE]]}, "", in_building, 0) == polygon(SQUARE)


def test_of_a_venue_the_levels_of_the_ordinal_are_taken() -> None:
    amenity = {"type": "Feature", "feature_type": "amenity", "properties": {}, "geometry": None}
    venue = collection(amenity, level(1, polygon(HOLE)), level(0), level(0, polygon(shifted(SQUARE, 20))))
    assert read_outline(venue, "", in_building, 1) == polygon(HOLE)
    assert len(read_outline(venue, "", in_building, 0)["coordinates"]) == 2
    assert [(each.ordinal, each.name) for each in read_levels(venue, "", in_building)] == [(0, "L0"), (1, "L1")]


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ({"de": "Erdgeschoss", "en": "Ground"}, "Ground"), ({"de": "Keller"}, "Keller"), ({}, "Level 0"),
        ({"fr": "Rez", "en-GB": "Ground"}, "Ground"), (None, "Level 0"),
    ],
)  # fmt: skip
def test_a_levels_name_is_the_english_one_or_the_first(name: Any, read: str) -> None:
    assert read_levels(collection(level(0, name=name)), "", in_building)[0].name == read


@pytest.mark.parametrize(
    "name", ["Ground", {"en": ""}, {"en": "a\x00b"}, {"en": "\ud800"}, {"en": 5}, {"en": "x" * 201}]
)
def test_a_name_that_cannot_be_shown_is_refused(name: Any) -> None:
    with pytest.raises(InvalidInput) as caught:
        read_levels(collection(level(0), level(1, name=name)), "/body", in_building)
    assert caught.value.faults[0].location == "/body/features/1/properties/name"


def test_a_collection_without_the_ordinal_says_which_there_are() -> None:
    where, why = refusal(collection(level(3), level(-1), level(3)))
    assert where == "/body/features"
    assert "ordinal 0; there are: -1, 3" in why
    assert "no level at all" in refusal(collection())[1]


NAN, INF = json.loads("NaN"), json.loads("1e999")


@pytest.mark.parametrize(
    ("geojson", "where", "why"),
    [
        ([], "/body", "a GeoJSON object is expected"),
        ({"type": "Point", "coordinates": [0, 0]}, "/body/type", "'Point'"),
        ({"type": "\ud800"}, "/body/type", "ud800"),
        ({"type": ["Polygon"]}, "/body/type", "list"),
        ({"type": "Feature", "geometry": None}, "/body/geometry", "nothing"),
        ({"type": "FeatureCollection"}, "/body/features", "a list of features"),
        (collection(7), "/body/features/0", "a GeoJSON object"),
        (collection(level("0")), "/body/features/0/properties/ordinal", "whole number"),
        (collection(level(True)), "/body/features/0/properties/ordinal", "whole number"),
        (collection(level(0, {"type": "Point"})), "/body/features/0/geometry/type", "Polygon"),
        ({"type": "Polygon"}, "/body/coordinates", "nothing"),
        (polygon(), "/body/coordinates", "1 or more"),
        (polygon(SQUARE[:3]), "/body/coordinates/0", "4 or more positions"),
        (polygon(SQUARE[:-1]), "/body/coordinates/0", "not closed"),
        (polygon(SQUARE, [*HOLE[:-1], [2.0, 2.1]]), "/body/coordinates/1", "[2.0, 2.1] must repeat its first"),
        (polygon([*SQUARE[:2], [NAN, 1], *SQUARE[2:]]), "/body/coordinates/0/2/0", "finite"),
        (polygon([*SQUARE[:2], [1, INF], *SQUARE[2:]]), "/body/coordinates/0/2/1", "finite"),
        (polygon([*SQUARE[:2], [1, 10**400], *SQUARE[2:]]), "/body/coordinates/0/2/1", "finite"),
        (polygon([*SQUARE[:2], [1, True], *SQUARE[2:]]), "/body/coordinates/0/2/1", "True"),
        (polygon([*SQUARE[:2], ["1", 2], *SQUARE[2:]]), "/body/coordinates/0/2/0", "'1'"),
        (polygon([*SQUARE[:2], [1], *SQUARE[2:]]), "/body/coordinates/0/2", "two or three"),
        (polygon([*SQUARE[:2], [2e6, 1], *SQUARE[2:]]), "/body/coordinates/0/2", "of the origin"),
        (polygon([*SQUARE[:2], [2e4, 1], *SQUARE[2:]]), "/body", "is it in metres"),
        (polygon([[x / 1e4, y / 1e4] for x, y in SQUARE]), "/body", "coordinates=wgs84"),
        ({"type": "MultiPolygon", "coordinates": [[SQUARE], [SQUARE[:2]]]}, "/body/coordinates/1/0", "4 or more"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_refused_with_where_and_why(geojson: Any, where: str, why: str) -> None:
    location, reason = refusal(geojson)
    assert location == where
    assert why in reason


def test_too_many_positions_are_refused() -> None:
    ring = [[float(k % 300), float(k // 300)] for k in range(100_001)]
    with pytest.raises(InvalidInput, match="simplify"):
        outline_of([[[*ring, ring[0]]]], "/body")


def around(lon: float, lat: float, size_deg: float = 1e-3) -> dict[str, Any]:
    corners = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    return polygon([[lon + size_deg * x, lat + size_deg * y] for x, y in corners])


def test_longitudes_and_latitudes_become_building_metres() -> None:
    """A thousandth of a degree at 48.14 N, by the radii of curvature; +x is east, since the bearing is 90 degrees."""
    outline = read_outline(around(11.56, 48.14), "", on_earth(ANCHOR), 0)
    ring = np.array(outline["coordinates"][0])
    np.testing.assert_allclose(ring[0], 0.0, atol=1e-3)
    np.testing.assert_allclose(ring[2], [74.40, 111.21], atol=0.03)
    assert ring[0].tolist() == ring[-1].tolist()


@pytest.mark.parametrize(
    ("lon", "lat", "why"),
    [
        (139.7, 95.0, "out of range"), (195.0, 48.0, "out of range"), (48.14, 11.56, "near it when swapped"),
        (11.76, 48.14, "10 km from the building's anchor"), (-168.44, -48.14, "10 km from the building's anchor"),
    ],
)  # fmt: skip
def test_positions_elsewhere_on_earth_are_refused(lon: float, lat: float, why: str) -> None:
    where, reason = refusal(around(lon, lat), on_earth(ANCHOR))
    assert where == "/body/coordinates/0/0"
    assert why in reason


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
        st.sampled_from(["type", "coordinates", "features", "geometry", "properties", "ordinal", "feature_type"]), inner
    ),
    max_leaves=20,
)  # fmt: skip


@given(st.sampled_from(["Polygon", "MultiPolygon", "Feature", "FeatureCollection"]), json_values, json_values)
def test_any_json_is_read_or_refused(kind: str, coordinates: Any, other: Any) -> None:
    geojson = {"type": kind, "coordinates": coordinates, "features": [other], "geometry": other}
    for place in (in_building, on_earth(ANCHOR)):
        with suppress(InvalidInput):
            outline = read_outline(geojson, "/body", place, 0)
            assert read_polygons(outline, "", in_building)
