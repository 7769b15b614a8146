"""Buildings: make, list, change."""

from datetime import datetime
from typing import Annotated

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from pydantic.config import JsonDict
from sqlalchemy.orm import Session

from app.api.auth import BuildingMaking, MapWriting, Reading, actor
from app.api.caching import IfMatch, check_unchanged, pointer
from app.api.context import ContextDep
from app.api.idempotency import IdempotencyKey, answer_once
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Finite, Id, Name, RequestModel, unchanged
from app.api.ownership import find_own, own
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Building
from app.services.audit_log import record

__all__ = ["router"]

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


ANCHOR: JsonDict = {"latitude_deg": 48.1403, "longitude_deg": 11.5583, "height_m": 570.0, "bearing_deg": 82.5}


class BuildingPatch(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"anchor": ANCHOR}]})
    name: Name = unchanged()
    anchor: Annotated[Anchor | None, Field(description="null removes it")] = unchanged()


class BuildingView(BaseModel):
    id: str
    name: str
    anchor: Anchor | None
    created_at: datetime


def show_building(row: Building) -> BuildingView:
    return BuildingView.model_validate(row, from_attributes=True)


@router.post("/buildings", status_code=201, response_model=BuildingView, summary="Make a building")
def create_building(
    body: NewBuilding, request: Request, context: ContextDep, identity: BuildingMaking, key: IdempotencyKey = None
) -> Response:
    def create(session: Session) -> tuple[int, BaseModel]:
        row = Building(organisation_id=identity.organisation_id, name=body.name,
                       anchor=body.anchor.model_dump() if body.anchor else None)  # fmt: skip
        session.add(row)
        session.flush()
        context.quotas.check_buildings(session, identity.organisation_id)
        record(session, actor(request, identity), "create", row)
        return 201, show_building(row)

    return answer_once(context, identity, request, key, body.model_dump_json().encode(), create)


@router.get("/buildings", summary="List buildings")
def list_buildings(context: ContextDep, identity: Reading, paging: PagingDep) -> Page[BuildingView]:
    with context.transaction() as session:
        return list_page(session, own(identity, Building), Building.id, paging, show_building)


@router.get("/buildings/{building_id}", response_model=BuildingView, summary="One building")
def get_building(building_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    with context.transaction() as session:
        return pointer(request, show_building(find_own(session, identity, Building, building_id)))


@router.patch("/buildings/{building_id}", summary="Change a building's name or anchor")
def patch_building(
    building_id: Id, body: BuildingPatch, request: Request, context: ContextDep, identity: MapWriting,
    _: IfMatch = None,
) -> BuildingView:  # fmt: skip
    """What is not given stays. Outlines that came as longitude and latitude were put into building metres by the anchor
    of that time, and do not move with a new one: send them again."""
    with context.transaction() as session:
        row = find_own(session, identity, Building, building_id)
        check_unchanged(request, show_building(row))
        for name, value in body.model_dump(exclude_unset=True).items():
            setattr(row, name, value)
        session.flush()
        record(session, actor(request, identity), "change", row, fields=sorted(body.model_fields_set))
        return show_building(row)
