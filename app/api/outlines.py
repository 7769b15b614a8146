"""Outlines of floors from GeoJSON and IMDF: of one floor, or of all the levels of a building at once."""

from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Query, Request, Response
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from app.api.auth import MapWriting, actor
from app.api.context import ContextDep
from app.api.floors import FloorView, show_floor
from app.api.idempotency import IdempotencyKey, RawBody, answer_once
from app.api.models import Finite, Id
from app.api.ownership import find_own
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Building, Floor
from app.errors import Conflict
from app.geodesy import Anchor
from app.outline.levels import read_levels, read_outline
from app.outline.polygons import Place, in_building, on_earth
from app.services.audit_log import record
from app.services.import_floors import import_floors

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["floors"], responses=ERROR_RESPONSES)

POLYGON = {"type": "Polygon", "coordinates": [[[0, 0], [40, 0], [40, 18], [0, 18], [0, 0]]]}
LEVELS = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "feature_type": "level",
            "properties": {"ordinal": 0, "name": {"en": "Ground floor"}},
            "geometry": POLYGON,
        }
    ],
}


def _geojson(*kinds: str) -> dict[str, Any]:
    return {"type": "object", "required": ["type"], "properties": {"type": {"enum": list(kinds)}}}


def _body(schema: dict[str, Any], examples: dict[str, Any]) -> dict[str, Any]:
    content = {"schema": schema, "examples": {name: {"value": value} for name, value in examples.items()}}
    media_types = ("application/geo+json", "application/json")
    return {"requestBody": {"required": True, "content": dict.fromkeys(media_types, content)}}


_OUTLINE = _geojson("Polygon", "MultiPolygon", "Feature", "FeatureCollection")
_COLLECTION = _geojson("FeatureCollection")
GeoJson = Annotated[dict[str, Any], Body()]
Coordinates = Annotated[
    Literal["building", "wgs84"],
    Query(description="what the coordinates are: building metres, or longitude and latitude in degrees (as in IMDF)"),
]


class ImportView(BaseModel):
    """Every floor a level was for, lowest first."""

    made: Annotated[list[FloorView], Field(description="floors that were missing")]
    changed: Annotated[list[FloorView], Field(description="floors that have another outline now")]
    unchanged: Annotated[list[FloorView], Field(description="floors that had this outline already")]


@router.put(
    "/floors/{floor_id}/outline",
    openapi_extra=_body(_OUTLINE, {"polygon": POLYGON, "levels": LEVELS}),
    summary="Give a floor its outline",
)
def put_outline(
    floor_id: Id,
    body: GeoJson,
    request: Request,
    context: ContextDep,
    identity: MapWriting,
    coordinates: Coordinates = "building",
) -> FloorView:
    """A GeoJSON Polygon, MultiPolygon, Feature, or the FeatureCollection of an indoor map (IMDF), of which the level
    whose `properties.ordinal` is the floor's own is taken; several of that ordinal are taken together.

    `coordinates=wgs84` needs the building's anchor (409 without). `PATCH` with `{"outline": null}` removes it.
    """
    with context.transaction() as session:
        floor = find_own(session, identity, Floor, floor_id)
        place = _place(session.get_one(Building, floor.building_id), coordinates)
        floor.outline = read_outline(body, "/body", place, floor.ordinal)
        session.flush()
        record(session, actor(request, identity), "change", floor, fields=["outline"])
        return show_floor(floor)


@router.post(
    "/buildings/{building_id}/floors:import",
    response_model=ImportView,
    openapi_extra=_body(_COLLECTION, {"levels": LEVELS}),
    summary="Make and outline floors from an indoor map",
)
def post_import(
    building_id: Id, body: GeoJson, raw: RawBody, request: Request, context: ContextDep, identity: MapWriting,
    coordinates: Coordinates = "building",
    storey_height_m: Annotated[
        Finite, Query(gt=0, le=100, description="a new floor's elevation is its ordinal times this")
    ] = 4.0,
    key: IdempotencyKey = None,
) -> Response:  # fmt: skip
    """A FeatureCollection of IMDF levels: floors are matched by ordinal; the missing ones are made, with the level's
    name, the others get its outline and keep name and elevation. All of it is done or nothing.

    An indoor map does not say how high its levels lie: `PATCH` a floor's `elevation_m` before its first survey.
    """

    def create(session: Session) -> tuple[int, BaseModel]:
        building = find_own(session, identity, Building, building_id)
        levels = read_levels(body, "/body", _place(building, coordinates))
        imported = import_floors(session, building, levels, storey_height_m)
        context.quotas.check_floors(session, building.id)
        record(session, actor(request, identity), "import", building, made=[floor.id for floor in imported.made],
               changed=[floor.id for floor in imported.changed])  # fmt: skip
        return 200, ImportView(
            made=[show_floor(floor) for floor in imported.made],
            changed=[show_floor(floor) for floor in imported.changed],
            unchanged=[show_floor(floor) for floor in imported.unchanged],
        )

    return answer_once(context, identity, request, key, raw, create)


def _place(building: Building, coordinates: str) -> Place:
    """What puts coordinates into the building frame. Raises Conflict where that takes an anchor there is not."""
    if coordinates == "building":
        return in_building
    if building.anchor is None:
        raise Conflict(
            f"building {building.id} has no anchor, so longitudes and latitudes cannot be placed: PATCH "
            f"/v1/buildings/{building.id} with its anchor first, or send building metres"
        )
    return on_earth(Anchor(**building.anchor))
