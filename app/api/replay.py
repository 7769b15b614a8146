"""Replay a walk against a floor's map: window after window, beside where it was. Nothing is stored."""

import asyncio
from collections.abc import AsyncIterator
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, Field

from app.api.auth import Identity, Locating
from app.api.body import upload
from app.api.calibration_request import CalibrationId, DeviceQuery
from app.api.context import Context, ContextDep
from app.api.models import Finite, Id
from app.api.ownership import find_own
from app.api.problems import ERROR_RESPONSES
from app.api.surveys import SURVEY_FILES, SurveyFormat
from app.db.tables import Floor
from app.errors import Conflict
from app.services.calibrations import AppliedCalibration, find_calibration
from app.services.file_orders import SurveyOrder
from app.services.locate_window import ActiveMap, active_maps
from app.services.replay_walk import Replay, ReplayedFix, replay_walk

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["locate"], responses=ERROR_RESPONSES)
MOST_PATH_POINTS = 2000


class ReplayedPath(BaseModel):
    """The first line: the path that was walked, thinned, and how many windows follow."""

    kind: Literal["path"] = "path"
    floor_id: str
    path_m: list[list[float]]
    windows: int


class ReplayedWindow(BaseModel):
    """One line a window: what was answered, of its last sample, and how far that is from where it was."""

    kind: Literal["window"] = "window"
    t_s: float
    truth_m: list[float]
    status: Literal["fix", "ambiguous", "inconsistent", "unmapped"]
    reason: str | None
    position_m: list[float] | None
    covariance_m2: list[list[float]] | None
    radius_95_m: float | None
    probability: Annotated[float | None, Field(description="of the strongest mode")]
    error_m: Annotated[float | None, Field(description="of the position, along the floor")]


@router.post(
    "/floors/{floor_id}/replay",
    summary="Replay a walk against the floor's map",
    response_class=StreamingResponse,
    openapi_extra={"requestBody": SURVEY_FILES},
    responses={200: {"description": "JSON lines: a path, then a line a window as it is answered",
                     "content": {"application/x-ndjson": {"schema": {"type": "string"}}}}},
)  # fmt: skip
async def replay(
    floor_id: Id,
    request: Request,
    context: ContextDep,
    identity: Locating,
    format: Annotated[SurveyFormat, Query(description="what the bytes are")] = "csv",
    frame: Annotated[
        Literal["building", "level", "norm"], Query(description="what b is when there is no quaternion")
    ] = "building",
    window_m: Annotated[Finite, Query(ge=1, le=200, description="length of a window, walked")] = 10.0,
    every_m: Annotated[Finite, Query(ge=0.2, le=200, description="from one window to the next")] = 2.0,
    calibration_id: CalibrationId = None,
    device: DeviceQuery = None,
) -> StreamingResponse:
    """The walk is read as a survey would be and never stored. Windows are asked without a prior, on this floor, and
    take their turn with those of others; a client that goes away ends the work."""
    elevation_m, maps, calibration = await run_in_threadpool(
        _floor_and_maps, context, identity, floor_id, calibration_id, device
    )

    def begin(data: bytes) -> Replay:
        correct = None if calibration is None else calibration.model
        walk = context.files.survey(SurveyOrder(data, format, frame, elevation_m, correct=correct))
        floors = context.grids.searchable([(each.floor_id, each.grid_sha256) for each in maps])
        return replay_walk(walk, floors, window_m, every_m)

    context.uploads.check()
    async with upload(request, context.settings.max_upload_bytes, context.bodies, identity.organisation_id) as data:
        begun = await context.uploads.run(lambda: begin(data), request.is_disconnected)
    context.searches.check()
    return StreamingResponse(_lines(context, floor_id, begun), media_type="application/x-ndjson")


def _floor_and_maps(
    context: Context, identity: Identity, floor_id: str, calibration_id: str | None, device: str | None
) -> tuple[float, list[ActiveMap], AppliedCalibration | None]:
    """The floor's elevation and its active map, and the device's calibration. Raises NotFound, Conflict."""
    with context.transaction() as session:
        elevation_m = find_own(session, identity, Floor, floor_id).elevation_m
        maps = active_maps(session.connection(), identity.reach, floor_ids=[floor_id])
        calibration = find_calibration(session, identity.organisation_id, calibration_id, device)
    if not maps:
        raise Conflict(f"floor {floor_id} has no map yet; upload surveys and wait for its job")
    return elevation_m, maps, calibration


async def _lines(context: Context, floor_id: str, begun: Replay) -> AsyncIterator[str]:
    shown = np.linspace(0, len(begun.path_m) - 1, min(len(begun.path_m), MOST_PATH_POINTS)).astype(int)
    yield _line(ReplayedPath(floor_id=floor_id, path_m=begun.path_m[shown].tolist(), windows=begun.windows))
    lines = (_line(_shown(fix)) for fix in begun.fixes)
    loop = asyncio.get_running_loop()
    while line := await loop.run_in_executor(context.searches, lambda: next(lines, None)):
        yield line


def _shown(replayed: ReplayedFix) -> ReplayedWindow:
    posterior = replayed.fix.posterior
    told: dict[str, Any] = dict.fromkeys(("position_m", "covariance_m2", "radius_95_m", "probability"))
    if posterior is not None:
        told = {
            "position_m": list(posterior.position_m), "covariance_m2": posterior.covariance_m2.tolist(),
            "radius_95_m": posterior.radius_95_m,
            "probability": max((mode.probability for mode in posterior.modes), default=None),
        }  # fmt: skip
    return ReplayedWindow(
        t_s=replayed.t_s, truth_m=replayed.truth_m.tolist(), status=replayed.fix.status, reason=replayed.fix.reason,
        error_m=replayed.error_m, **told,
    )  # fmt: skip


def _line(model: BaseModel) -> str:
    return model.model_dump_json() + "\n"
