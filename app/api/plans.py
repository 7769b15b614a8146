"""The plan of a floor: a picture, and where it lies in the building frame."""

from math import pi
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool

from app.api.auth import Identity, MapWriting, Reading, actor
from app.api.body import upload
from app.api.caching import changing
from app.api.context import Context, ContextDep
from app.api.floors import FloorView, show_floor
from app.api.models import Finite, Id, Metres
from app.api.ownership import find_own
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Floor
from app.errors import NotFound
from app.services.audit_log import record
from app.services.receive_plan import MAX_PLAN_BYTES, Placement, Plan, place_plan

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["floors"], responses=ERROR_RESPONSES)

_BINARY: dict[str, Any] = {"schema": {"type": "string", "format": "binary"}}
_PICTURES: dict[str, Any] = {
    "required": True,
    "content": dict.fromkeys(("image/png", "image/jpeg", "image/webp", "application/octet-stream"), _BINARY),
}


@router.put(
    "/floors/{floor_id}/plan",
    response_model=FloorView,
    openapi_extra={"requestBody": _PICTURES},
    summary="Put a plan on a floor",
)
async def put_plan(
    floor_id: Id,
    request: Request,
    context: ContextDep,
    identity: MapWriting,
    metres_per_pixel: Annotated[
        Finite, Query(gt=0, le=100, description="side of one pixel of the picture that is sent", examples=[0.02])
    ],
    x_m: Annotated[Metres, Query(description="building x of the picture's lower left corner")] = 0.0,
    y_m: Annotated[Metres, Query(description="building y of the picture's lower left corner")] = 0.0,
    bearing_rad: Annotated[
        Finite,
        Query(
            ge=-2 * pi, le=2 * pi, description="of the picture's lower side, counter-clockwise from the building's x"
        ),
    ] = 0.0,
) -> FloorView:
    """The body is a PNG, JPEG or WebP picture of at most 20 MiB and 40 megapixels, not animated; it replaces the plan
    there was. A clean copy without metadata is kept, its longest side at most 4096 pixels; its size in metres stays.
    """
    await run_in_threadpool(_check_floor, context, identity, floor_id)
    placement = Placement(metres_per_pixel, x_m, y_m, bearing_rad)

    def receive(data: bytes) -> FloorView:
        plan = place_plan(context.blobs, data, placement, context.files.picture)
        return _point_to(context, request, identity, floor_id, plan)

    context.uploads.check()
    async with upload(request, MAX_PLAN_BYTES, context.bodies, identity.organisation_id) as data:
        return await context.uploads.run(lambda: receive(data), request.is_disconnected)


@router.get(
    "/floors/{floor_id}/plan",
    response_class=Response,
    responses={200: {"content": {"image/png": _BINARY, "image/webp": _BINARY}}},
    summary="The picture of a floor's plan",
)
def get_plan(floor_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    """The floor itself says where the picture lies."""
    with context.transaction() as session:
        plan = find_own(session, identity, Floor, floor_id).plan
    if plan is None:
        raise NotFound(f"floor {floor_id} has no plan; PUT a picture here")
    response = changing(request, plan["sha256"], lambda: context.blobs.get(plan["sha256"]), plan["media_type"])
    response.headers["X-Content-Type-Options"] = "nosniff"
    return response


@router.delete("/floors/{floor_id}/plan", status_code=204, summary="Take a floor's plan away")
def delete_plan(floor_id: Id, request: Request, context: ContextDep, identity: MapWriting) -> Response:
    """Also answers 204 where there is none."""
    _point_to(context, request, identity, floor_id, None)
    return Response(status_code=204)


def _check_floor(context: Context, identity: Identity, floor_id: str) -> None:
    """Raise NotFound before the body is read."""
    with context.transaction() as session:
        find_own(session, identity, Floor, floor_id)


def _point_to(context: Context, request: Request, identity: Identity, floor_id: str, plan: Plan | None) -> FloorView:
    with context.transaction() as session:
        floor = find_own(session, identity, Floor, floor_id)
        floor.plan = plan.as_row() if plan else None
        session.flush()
        record(session, actor(request, identity), "change", floor, fields=["plan"])
        return show_floor(floor)
