"""Buildings and their floors."""

from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Request, Response
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.api.auth import Identity, MapWriting, Reading
from app.api.caching import pointer
from app.api.context import ContextDep
from app.api.idempotency import IdempotencyKey, answer_once
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Finite, Id, Metres, Name, RequestModel
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Building, Floor
from app.errors import NotFound

__all__ = ["find_building", "find_floor", "router"]

router = APIRouter(prefix="/v1", tags=["buildings"], responses=ERROR_RESPONSES)


class Anchor(RequestModel):
    """Where the building frame's origin lies on Earth, and the bearing of its +x from true north."""

    latitude_deg: Annotated[Finite, Field(ge=-90, le=90)]
    longitude_deg: Annotated[Finite, Field(ge=-180, le=180)]
    height_m: Annotated[Finite, Field(ge=-1000, le=10000)]
    bearing_deg: Annotated[Finite, Field(ge=-360, le=360)]


class NewBuilding(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"name": "Main station"}]})
    name: Name
    anchor: Anchor | None = None


class BuildingView(BaseModel):
    id: str
    name: str
    anchor: Anchor | None
    created_at: datetime


def _closed(rings: list[list[list[float]]]) -> list[list[list[float]]]:
    for ring in rings:
        if ring[0] != ring[-1]:
            raise ValueError("a ring's last point must repeat its first")
    return rings


Coordinate = Annotated[list[Metres], Field(min_length=2, max_length=3)]
Ring = Annotated[list[Coordinate], Field(min_length=4, max_length=10_000)]


class Outline(RequestModel):
    """A GeoJSON Polygon in building metres."""

    type: Literal["Polygon"]
    coordinates: Annotated[list[Ring], Field(min_length=1, max_length=100), AfterValidator(_closed)]


class NewFloor(RequestModel):
    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{"name": "Ground floor", "ordinal": 0, "elevation_m": 0.0}]}
    )
    name: Name
    ordinal: Annotated[int, Field(ge=-1000, le=1000, description="0 is the ground floor")]
    elevation_m: Annotated[Metres, Field(description="z of the slab in the building frame")] = 0.0
    height_m: Annotated[Finite, Field(gt=0, le=1000)] | None = None
    outline: Outline | None = None
    auto_build: Annotated[bool, Field(description="rebuild the map after every change of surveys")] = True


class FloorView(BaseModel):
    id: str
    building_id: str
    name: str
    ordinal: int
    elevation_m: float
    height_m: float | None
    outline: dict[str, Any] | None
    auto_build: bool
    active_map_id: str | None
    created_at: datetime


def show_building(row: Building) -> BuildingView:
    return BuildingView.model_validate(row, from_attributes=True)


def show_floor(row: Floor) -> FloorView:
    return FloorView.model_validate(row, from_attributes=True)


def find_building(session: Session, identity: Identity, building_id: str) -> Building:
    """The organisation's building. Raises NotFound."""
    row = session.get(Building, building_id)
    if row is None or row.organisation_id != identity.organisation_id:
        raise NotFound(f"no building {building_id}")
    return row


def find_floor(session: Session, identity: Identity, floor_id: str) -> Floor:
    """The organisation's floor. Raises NotFound."""
    row = session.get(Floor, floor_id)
    if row is None or row.organisation_id != identity.organisation_id:
        raise NotFound(f"no floor {floor_id}")
    return row


@router.post("/buildings", status_code=201, response_model=BuildingView, summary="Make a building")
def create_building(
    body: NewBuilding, request: Request, context: ContextDep, identity: MapWriting, key: IdempotencyKey = None
) -> Response:
    def create(session: Session) -> tuple[int, BaseModel]:
        row = Building(organisation_id=identity.organisation_id, name=body.name,
                       anchor=body.anchor.model_dump() if body.anchor else None)  # fmt: skip
        session.add(row)
        session.flush()
        return 201, show_building(row)

    return answer_once(context, identity, request, key, body.model_dump_json().encode(), create)


@router.get("/buildings", summary="List buildings")
def list_buildings(context: ContextDep, identity: Reading, paging: PagingDep) -> Page[BuildingView]:
    with context.transaction() as session:
        mine = select(Building).where(Building.organisation_id == identity.organisation_id)
        return list_page(session, mine, Building.id, paging, show_building)


@router.get("/buildings/{building_id}", response_model=BuildingView, summary="One building")
def get_building(building_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    with context.transaction() as session:
        return pointer(request, show_building(find_building(session, identity, building_id)))


@router.post("/buildings/{building_id}/floors", status_code=201, response_model=FloorView, summary="Add a floor")
def create_floor(
    building_id: Id, body: NewFloor, request: Request, context: ContextDep, identity: MapWriting,
    key: IdempotencyKey = None,
) -> Response:  # fmt: skip
    def create(session: Session) -> tuple[int, BaseModel]:
        building = find_building(session, identity, building_id)
        row = Floor(organisation_id=identity.organisation_id, building_id=building.id,
                    **body.model_dump(exclude={"outline"}),
                    outline=body.outline.model_dump() if body.outline else None)  # fmt: skip
        session.add(row)
        session.flush()
        return 201, show_floor(row)

    return answer_once(context, identity, request, key, body.model_dump_json().encode(), create)


@router.get("/buildings/{building_id}/floors", summary="List a building's floors")
def list_floors(building_id: Id, context: ContextDep, identity: Reading, paging: PagingDep) -> Page[FloorView]:
    with context.transaction() as session:
        find_building(session, identity, building_id)
        return list_page(session, select(Floor).where(Floor.building_id == building_id), Floor.id, paging, show_floor)


@router.get("/floors/{floor_id}", response_model=FloorView, summary="One floor, and the map it answers with")
def get_floor(floor_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    with context.transaction() as session:
        return pointer(request, show_floor(find_floor(session, identity, floor_id)))
