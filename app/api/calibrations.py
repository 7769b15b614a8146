"""Calibrations of a device's magnetometer: make one, list them, compare them. A calibration never changes."""

from dataclasses import asdict
from datetime import UTC, datetime
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from app.api.auth import Calibrating, CalibrationReading, actor
from app.api.calibration_request import Method, NewCalibration
from app.api.context import ContextDep
from app.api.idempotency import IdempotencyKey, RawBody, answer_once, answered_before
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Finite, Id, Name
from app.api.ownership import find_own, own
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Calibration
from app.services.audit_log import record
from app.services.calibrate import calibrate
from app.services.calibrations import compare_devices, device_drift, keep_readings, record_calibration

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["calibration"], responses=ERROR_RESPONSES)


class ModelView(BaseModel):
    """`B = correction (b - hard_iron)` for a reading b, all in the sensor's own axes."""

    hard_iron_ut: list[float]
    correction: list[list[float]]


class CoverageView(BaseModel):
    """Which directions of the field were seen, in the sensor's axes."""

    kind: str
    cells_seen: int
    cells: int
    unseen_axes: Annotated[list[str], Field(description="`+z`: no direction within 45 degrees of it was seen")]
    condition: float


class CalibrationView(BaseModel):
    id: str
    device: str
    version: Annotated[int, Field(description="counts the device's calibrations from 1")]
    method: str
    model: ModelView
    parameters: Annotated[dict[str, float], Field(description="the method's own, by name")]
    parameter_sd: Annotated[dict[str, float], Field(description="absent: the readings say nothing of it")]
    covariance: Annotated[list[list[float]], Field(description="of the parameters, in their order")]
    residual_rms_ut: float
    residual_max_ut: float
    samples: int
    outliers: int
    coverage: CoverageView
    determined: list[str]
    undetermined: list[str]
    advice: Annotated[list[str], Field(description="what would make it better")]
    reference: Annotated[dict[str, Any], Field(description="what it was measured against")]
    measured_at: datetime
    created_at: datetime


class DriftView(BaseModel):
    """A device's calibrations by one method over time: are they one and the same, and how fast do they change?"""

    device: str
    method: str
    calibration_ids: list[str]
    mean: dict[str, float]
    mean_sd: dict[str, float]
    rate_per_day: Annotated[dict[str, float] | None, Field(description="null: all of one time")]
    rate_sd_per_day: dict[str, float] | None
    chi2: float
    degrees: int
    p_same: Annotated[float, Field(description="of as much scatter by chance, were they one and the same")]
    p_line: Annotated[float | None, Field(description="of what scatters about the trend; null with fewer than three")]
    drifting: Annotated[list[str], Field(description="parameters whose rates chance does not explain")]
    words: str


class ComparisonView(BaseModel):
    """A field read by the second device and corrected as the first's: by how much it errs, over all directions."""

    first_id: str
    second_id: str
    worst_ut: float
    rms_ut: float
    worst_5_ut: Annotated[float, Field(description="the true worst error is above it with 95 % probability")]
    worst_95_ut: Annotated[float, Field(description="the true worst error is below it with 95 % probability")]
    p_same: float | None
    verdict: Literal["equivalent", "different", "not known"]
    words: str


def show_calibration(row: Calibration) -> CalibrationView:
    names = ("id", "device", "version", "method", "model", "reference", "measured_at", "created_at")
    return CalibrationView.model_validate({name: getattr(row, name) for name in names} | row.fit)


@router.post("/calibrations", status_code=201, response_model=CalibrationView, summary="Calibrate a device")
async def create_calibration(
    body: NewCalibration, raw: RawBody, request: Request, context: ContextDep, identity: Calibrating,
    key: IdempotencyKey = None,
) -> Response:  # fmt: skip
    """From readings taken while the device was turned, against the Earth's field (given, or by place and date), or from
    a walk through a mapped building. It becomes the device's newest version; those before stay as they are, and so do
    surveys they were applied to. Refused with advice where the readings do not determine it."""

    def create(session: Session) -> tuple[int, BaseModel]:
        row = record_calibration(
            session, identity.organisation_id, device=body.device, fit=fit, reference=reference,
            samples_sha256=samples_sha256, measured_at=body.measured_at or datetime.now(UTC),
        )  # fmt: skip
        record(session, actor(request, identity), "create", row, device=body.device)
        return 201, show_calibration(row)

    earlier = await run_in_threadpool(answered_before, context, identity, request, key, raw)
    if earlier is not None:
        return earlier
    # A search of its own, so in turn with those for positions; it and its readings before the transaction.
    work = partial(calibrate, context.sessions, context.grids, identity.reach, body.asked())
    fit, reference, readings = await context.searches.run(work, request.is_disconnected)
    samples_sha256 = await run_in_threadpool(keep_readings, context.blobs, readings)
    return await run_in_threadpool(partial(answer_once, context, identity, request, key, raw, create))


@router.get("/calibrations", summary="List calibrations")
def list_calibrations(
    context: ContextDep,
    identity: CalibrationReading,
    paging: PagingDep,
    device: Annotated[Name | None, Query(description="of this device only")] = None,
) -> Page[CalibrationView]:
    statement = own(identity, Calibration)
    if device is not None:
        statement = statement.where(Calibration.device == device)
    with context.transaction() as session:
        return list_page(session, statement, Calibration.id, paging, show_calibration)


@router.get("/calibrations:drift", summary="How a device's calibrations change over time")
def get_drift(
    context: ContextDep,
    identity: CalibrationReading,
    device: Annotated[Name, Query(examples=["robot-7"])],
    method: Annotated[Method | None, Query(description="default: that of its newest")] = None,
) -> DriftView:
    with context.transaction() as session:
        drift, ids = device_drift(session, identity.organisation_id, device, method)
        by = session.get_one(Calibration, ids[0]).method
    return DriftView(device=device, method=by, calibration_ids=ids, **asdict(drift))


@router.get("/calibrations:compare", summary="Are two devices equivalent, by their calibrations?")
def get_comparison(
    context: ContextDep,
    identity: CalibrationReading,
    first_id: Annotated[str, Query(max_length=64, pattern=r"^[A-Za-z0-9_-]+$")],
    second_id: Annotated[str, Query(max_length=64, pattern=r"^[A-Za-z0-9_-]+$")],
    magnitude_ut: Annotated[Finite, Query(gt=1, le=200, description="of the field it is asked for")] = 50.0,
    tolerance_ut: Annotated[Finite, Query(gt=0, le=100, description="what is equivalent enough")] = 1.0,
) -> ComparisonView:
    """Equivalent: with 95 % confidence they differ by less than the tolerance; different: by more; else not known, and
    better calibrations would tell. Both by one method."""
    with context.transaction() as session:
        told = compare_devices(session, identity.organisation_id, (first_id, second_id), magnitude_ut, tolerance_ut)
    return ComparisonView(
        first_id=first_id, second_id=second_id,
        **{name.replace("_uT", "_ut"): value for name, value in asdict(told).items()},
    )  # fmt: skip


@router.get("/calibrations/{calibration_id}", summary="One calibration")
def get_calibration(calibration_id: Id, context: ContextDep, identity: CalibrationReading) -> CalibrationView:
    with context.transaction() as session:
        return show_calibration(find_own(session, identity, Calibration, calibration_id))
