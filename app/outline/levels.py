"""The levels of an indoor map: GeoJSON features of IMDF (OGC 20-094, "Level"), one or several per ordinal.

Only what a floor needs is read: `feature_type` "level", `properties.ordinal`, `properties.name` (text by language) and
the geometry. Features of other types are passed over, so the collection may be a whole venue.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from unicodedata import category

from app.outline.polygons import Outline, Place, members, outline_of, read_polygons, refuse

__all__ = ["Level", "read_levels", "read_outline"]

ORDINALS = range(-1000, 1001)
MOST_LETTERS = 200


@dataclass(frozen=True, slots=True)
class Level:
    """What a map says of the floor of this ordinal; `outline` in building metres."""

    ordinal: int
    name: str
    outline: Outline


def read_levels(collection: object, where: str, place: Place) -> list[Level]:
    """The levels of a FeatureCollection, lowest first; features of one ordinal together make one level.

    Raises InvalidInput for what is no such collection, and for a level that cannot be read.
    """
    by_ordinal: dict[int, list[tuple[dict[str, Any], str]]] = {}
    for feature, pointer in _level_features(collection, where):
        by_ordinal.setdefault(_ordinal(feature, pointer), []).append((feature, pointer))
    if not by_ordinal:
        refuse(f"{where}/features", 'there is no level here: no feature has the feature_type "level"')
    return [_level(ordinal, features, place) for ordinal, features in sorted(by_ordinal.items())]


def read_outline(geojson: object, where: str, place: Place, ordinal: int) -> Outline:
    """The outline that a Polygon, MultiPolygon, Feature, or the levels of a collection give a floor of this ordinal.

    Raises InvalidInput; for a collection without a level of the ordinal with those there are.
    """
    kind = members(geojson, where).get("type")
    if kind == "Feature":
        return _merged([(members(geojson, where), where)], place)
    if kind != "FeatureCollection":
        return outline_of(read_polygons(geojson, where, place), where)
    found = [(_ordinal(feature, pointer), feature, pointer) for feature, pointer in _level_features(geojson, where)]
    wanted = [(feature, pointer) for each, feature, pointer in found if each == ordinal]
    if not wanted:
        there = ", ".join(map(str, sorted({each for each, *_ in found}))) or "no level at all"
        refuse(f"{where}/features", f"no level has the floor's ordinal {ordinal}; there are: {there}")
    return _merged(wanted, place)


def _level_features(collection: object, where: str) -> Iterator[tuple[dict[str, Any], str]]:
    """The features of levels, with the JSON pointer to each."""
    if members(collection, where).get("type") != "FeatureCollection":
        refuse(f"{where}/type", "a FeatureCollection is expected")
    features = members(collection, where).get("features")
    if not isinstance(features, list):
        refuse(f"{where}/features", "a list of features is expected")
    for k, feature in enumerate(features):
        if members(feature, f"{where}/features/{k}").get("feature_type") == "level":
            yield feature, f"{where}/features/{k}"


def _level(ordinal: int, features: list[tuple[dict[str, Any], str]], place: Place) -> Level:
    feature, pointer = features[0]
    name = _name(members(feature.get("properties"), f"{pointer}/properties").get("name"), f"{pointer}/properties/name")
    return Level(ordinal, name or f"Level {ordinal}", _merged(features, place))


def _merged(features: list[tuple[dict[str, Any], str]], place: Place) -> Outline:
    polygons = [
        polygon
        for feature, pointer in features
        for polygon in read_polygons(feature.get("geometry"), f"{pointer}/geometry", place)
    ]
    return outline_of(polygons, f"{features[0][1]}/geometry")


def _ordinal(feature: dict[str, Any], pointer: str) -> int:
    where = f"{pointer}/properties"
    ordinal = members(feature.get("properties"), where).get("ordinal")
    if isinstance(ordinal, bool) or not isinstance(ordinal, int) or ordinal not in ORDINALS:
        refuse(f"{where}/ordinal", f"a level has a whole number from {ORDINALS[0]} to {ORDINALS[-1]}; 0 is the ground")
    return ordinal


def _name(labels: object, where: str) -> str | None:
    """The English name, else the first; None where there is none."""
    if not labels:
        return None
    by_language = members(labels, where)
    english = (tag for tag in by_language if tag.lower().split("-")[0] == "en")
    name = by_language[next(english, next(iter(by_language)))]
    if not isinstance(name, str) or not 0 < len(name) <= MOST_LETTERS or any(category(c) in ("Cc", "Cs") for c in name):
        refuse(where, f"a name is text of 1 to {MOST_LETTERS} characters by language, without control characters")
    return name
