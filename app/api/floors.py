"""The floors of a building: add, list, change."""

from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.api.auth import MapWriting, Reading, actor
from app.api.caching import IfMatch, check_unchanged, pointer
from app.api.context import ContextDep
from app.api.idempotency import IdempotencyKey, RawBody, answer_once
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Finite, Id, Metres, Name, RequestModel, unchanged
from app.api.ownership import find_own
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Building, Floor, Map, Survey
from app.errors import Conflict
from app.jobs.queue import lock_floor
from app.outline.polygons import in_building, outline_of, read_polygons
from app.services.audit_log import record

__all__ = ["FloorView", "router", "show_floor"]

router = APIRouter(prefix="/v1", tags=["floors"], responses=ERROR_RESPONSES)

_RING = {
    "type": "array",
    "minItems": 4,
    "items": {"type": "array", "minItems": 2, "maxItems": 4, "items": {"type": "number"}},
}
_RINGS = {"type": "array", "minItems": 1, "items": _RING}


def _geometry(kind: str, coordinates: dict[str, Any]) -> dict[str, Any]:
    properties = {"type": {"const": kind}, "coordinates": coordinates}
    return {"type": "object", "required": ["type", "coordinates"], "properties": properties}


Outline = Annotated[
    dict[str, Any],
    WithJsonSchema(
        {
            "description": "a GeoJSON Polygon or MultiPolygon in building metres",
            "oneOf": [
                _geometry("Polygon", _RINGS),
                _geometry("MultiPolygon", {"type": "array", "minItems": 1, "items": _RINGS}),
            ],
            "examples": [{"type": "Polygon", "coordinates": [[[0, 0], [40, 0], [40, 18], [0, 18], [0, 0]]]}],
        }
    ),
]
Ordinal = Annotated[int, Field(ge=-1000, le=1000, description="0 is the ground floor")]
Elevation = Annotated[Metres, Field(description="z of the slab in the building frame")]
Height = Annotated[Finite, Field(gt=0, le=1000)]
AutoBuild = Annotated[bool, Field(description="rebuild the map after every change of surveys")]


class NewFloor(RequestModel):
    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"name": "Ground floor", "ordinal": 0, "elevation_m": 0.0}]}
    )
    name: Name
    ordinal: Ordinal
    elevation_m: Elevation = 0.0
    height_m: Height | None = None
    outline: Outline | None = None
    auto_build: AutoBuild = True


class FloorPatch(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"name": "Mezzanine", "outline": None}]})
    name: Name = unchanged()
    ordinal: Ordinal = unchanged()
    elevation_m: Elevation = unchanged()
    height_m: Annotated[Height | None, Field(description="null removes it")] = unchanged()
    outline: Annotated[Outline | None, Field(description="null removes it")] = unchanged()
    auto_build: AutoBuild = unchanged()


class PlanView(BaseModel):
    """A picture of the floor, and where it lies in the building frame."""

    sha256: Annotated[str, Field(description="of the stored picture: the ETag of `GET /v1/floors/{floor_id}/plan`")]
    media_type: Literal["image/png", "image/webp"]
    width_px: int
    height_px: int
    width_m: Annotated[float, Field(description="length of its lower side")]
    height_m: Annotated[float, Field(description="length of its left side")]
    metres_per_pixel: Annotated[float, Field(description="of the stored picture")]
    x_m: Annotated[float, Field(description="building x of its lower left corner")]
    y_m: Annotated[float, Field(description="building y of its lower left corner")]
    bearing_rad: Annotated[float, Field(description="of its lower side, counter-clockwise from the building's x")]


class FloorView(BaseModel):
    id: str
    building_id: str
    name: str
    ordinal: int
    elevation_m: float
    height_m: float | None
    outline: Outline | None
    plan: PlanView | None
    auto_build: bool
    active_map_id: str | None
    created_at: datetime


def show_floor(row: Floor) -> FloorView:
    return FloorView.model_validate(row, from_attributes=True)


def _read_outline(outline: dict[str, Any] | None) -> dict[str, Any] | None:
    """A body's outline as it is stored. Raises InvalidInput."""
    if outline is None:
        return None
    return outline_of(read_polygons(outline, "/body/outline", in_building), "/body/outline")


@router.post("/buildings/{building_id}/floors", status_code=201, response_model=FloorView, summary="Add a floor")
def create_floor(
    building_id: Id, body: NewFloor, raw: RawBody, request: Request, context: ContextDep, identity: MapWriting,
    key: IdempotencyKey = None,
) -> Response:  # fmt: skip
    def create(session: Session) -> tuple[int, BaseModel]:
        building = find_own(session, identity, Building, building_id)
        row = Floor(organisation_id=identity.organisation_id, building_id=building.id,
                    **body.model_dump(exclude={"outline"}), outline=_read_outline(body.outline))  # fmt: skip
        session.add(row)
        session.flush()
        context.quotas.check_floors(session, building.id)
        record(session, actor(request, identity), "create", row, building_id=building.id)
        return 201, show_floor(row)

    return answer_once(context, identity, request, key, raw, create)


@router.get("/buildings/{building_id}/floors", summary="List a building's floors")
def list_floors(building_id: Id, context: ContextDep, identity: Reading, paging: PagingDep) -> Page[FloorView]:
    with context.transaction() as session:
        find_own(session, identity, Building, building_id)
        return list_page(session, select(Floor).where(Floor.building_id == building_id), Floor.id, paging, show_floor)


@router.get("/floors/{floor_id}", response_model=FloorView, summary="One floor, and the map it answers with")
def get_floor(floor_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    with context.transaction() as session:
        return pointer(request, show_floor(find_own(session, identity, Floor, floor_id)))


@router.patch("/floors/{floor_id}", summary="Change a floor")
def patch_floor(
    floor_id: Id, body: FloorPatch, request: Request, context: ContextDep, identity: MapWriting, _: IfMatch = None
) -> FloorView:
    """What is not given stays; null removes `height_m` or `outline`, and is refused elsewhere.

    `elevation_m` changes only while the floor has neither surveys nor maps (409): samples and grids are stored with z
    in the building frame, traces raised by the elevation of that time, and would stay behind at the old height.
    `auto_build` takes effect with the next change of surveys.
    """
    changes = body.model_dump(exclude_unset=True, exclude={"outline"})
    with context.transaction() as session:
        row = find_own(session, identity, Floor, floor_id)
        if "if-match" in request.headers:
            lock_floor(session, row.id)
            session.refresh(row)
            check_unchanged(request, show_floor(row))
        if "outline" in body.model_fields_set:
            changes["outline"] = _read_outline(body.outline)
        if "elevation_m" in changes:
            lock_floor(session, row.id)
            session.refresh(row)
            _check_may_move(session, row, changes["elevation_m"])
        for name, value in changes.items():
            setattr(row, name, value)
        session.flush()
        record(session, actor(request, identity), "change", row, fields=sorted(body.model_fields_set))
        return show_floor(row)


def _check_may_move(session: Session, floor: Floor, elevation_m: float) -> None:
    """Raise Conflict if the floor is to move away from its surveys; it is locked, so that none comes meanwhile."""
    if floor.elevation_m == elevation_m:
        return
    for table in (Survey, Map):
        if session.scalars(select(table.id).where(table.floor_id == floor.id).limit(1)).first():
            raise Conflict(
                f"the floor has {table.__tablename__}s at the elevation {floor.elevation_m:g} m, which would not move "
                "with it; add a floor at the right elevation and upload the surveys there"
            )
