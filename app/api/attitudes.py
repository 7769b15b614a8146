"""Which way is a device turned? Inertial and magnetic samples in, orientations with their covariance out."""

from datetime import UTC, datetime
from datetime import date as Date
from typing import Annotated, Any, Literal, Self

import numpy as np
from fastapi import APIRouter
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field, model_validator

from app.api.auth import Identity, Measuring
from app.api.context import Context, ContextDep
from app.api.locate_request import FloorId
from app.api.models import AppliedView, Finite, Name, Point, RequestModel, Seconds
from app.api.problems import ERROR_RESPONSES
from app.attitude.euler import euler_zyx_rad, euler_zyx_variance_rad2
from app.attitude.mekf import AttitudeRun
from app.attitude.options import AttitudeOptions, InertialSamples
from app.errors import Fault, InvalidInput
from app.geometry import Array
from app.services.calibrations import find_calibration
from app.services.estimate_attitude import AskedReference, ReferenceKind, estimate_attitude, find_reference

__all__ = ["ImuRow", "router"]

router = APIRouter(prefix="/v1", tags=["attitude"], responses=ERROR_RESPONSES)

MOST_SAMPLES = 100_000
MAPPED_FIELD_UT = 0.5  # that a map leaves unexplained and does not state
Reading = Annotated[float, Field(allow_inf_nan=False, ge=-1e5, le=1e5)]
ImuRow = Annotated[list[Reading], Field(min_length=3, max_length=3)] | None
Rows = Annotated[list[ImuRow], Field(max_length=MOST_SAMPLES)]


class AttitudeReference(RequestModel):
    """What the magnetometer is compared with.

    none: gyroscope and accelerometer only, yaw is relative. learned: one field, of which nothing is known: yaw counts
    from its direction at the start. level: horizontal_ut and vertical_ut: yaw counts from magnetic north. wmm: the
    Earth's field at the building's anchor. map_point: a floor's map at one place. map: a floor's map where the device
    was at every sample.
    """

    kind: ReferenceKind
    building_id: Annotated[FloorId | None, Field(description="of wmm")] = None
    floor_id: Annotated[FloorId | None, Field(description="of map and map_point; of wmm instead of its building")] = (
        None
    )
    position_m: Annotated[
        Point | list[Point] | None,
        Field(min_length=1, max_length=MOST_SAMPLES, description="of map_point one place, of map one for every sample"),
    ] = None
    position_sd_m: Annotated[Finite, Field(ge=0, le=50, description="of the positions, per axis")] = 0.3
    horizontal_ut: Annotated[Finite | None, Field(gt=0.5, le=150)] = None
    vertical_ut: Annotated[Finite | None, Field(ge=-150, le=150, description="upwards: negative in the north")] = None
    date: Annotated[Date | None, Field(description="of wmm; default: today")] = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        kind = self.kind
        if kind in ("map", "map_point") and (self.floor_id is None or self.position_m is None):
            raise ValueError(f"{kind} needs floor_id and position_m")
        if kind == "wmm" and self.building_id is None and self.floor_id is None:
            raise ValueError("wmm needs building_id, or floor_id")
        if kind == "level" and (self.horizontal_ut is None or self.vertical_ut is None):
            raise ValueError("level needs horizontal_ut and vertical_ut")
        return self


class AttitudeOptionsBody(RequestModel):
    """What is known of the sensors. The defaults suit phones and body-worn sensors."""

    magnetometer_ut: Annotated[Finite | None, Field(gt=0, le=100, description="sd of a reading, per axis")] = None
    field_ut: Annotated[
        Finite | None, Field(ge=0, le=100, description="sd by which the field differs from the reference as one moves")
    ] = None
    hard_iron_ut: Annotated[
        Finite | None, Field(ge=0, le=1000, description="what is not known of the sensor's offset: learned on the way")
    ] = None
    gyro_noise_rad_per_sqrt_s: Annotated[Finite | None, Field(gt=0, le=1)] = None
    gyro_bias_rad_per_s: Annotated[Finite | None, Field(ge=0, le=1)] = None
    speed_m_per_s: Annotated[
        Finite | None, Field(gt=0, le=50, description="sd of the velocity, per axis: of a walk about 1")
    ] = None
    translation: Annotated[
        Literal["bounded", "ignored"] | None,
        Field(description="bounded: the device stays within reach of its place; ignored: the accelerometer is gravity"),
    ] = None


_EXAMPLE: dict[str, Any] = {
    "t_s": [0.0, 0.01, 0.02],
    "gyro_rad_per_s": [[0.0, 0.0, 0.1]] * 3,
    "accelerometer_m_per_s2": [[0.0, 0.1, 9.8]] * 3,
    "magnetometer_ut": [[19.8, 2.1, -43.0], None, [19.7, 2.1, -43.1]],
    "reference": {"kind": "level", "horizontal_ut": 20.1, "vertical_ut": -43.0},
}


class AttitudeQuery(RequestModel):
    """Samples in the device's axes, null where a sensor has none. At rest the accelerometer reads +g upwards."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [_EXAMPLE]})
    t_s: Annotated[list[Seconds], Field(min_length=2, max_length=MOST_SAMPLES)]
    gyro_rad_per_s: Rows
    accelerometer_m_per_s2: Rows
    magnetometer_ut: Rows | None = None
    reference: AttitudeReference
    calibration_id: Annotated[FloorId | None, Field(description="of the device, applied to magnetometer_ut")] = None
    device: Annotated[Name | None, Field(description="the same by name: its newest calibration")] = None
    options: AttitudeOptionsBody = AttitudeOptionsBody()
    every: Annotated[int, Field(ge=1, le=MOST_SAMPLES, description="answer one sample of so many, and the last")] = 1

    @model_validator(mode="after")
    def _lengths_agree(self) -> Self:
        for name in ("gyro_rad_per_s", "accelerometer_m_per_s2", "magnetometer_ut"):
            rows = getattr(self, name)
            if rows is not None and len(rows) != len(self.t_s):
                raise ValueError(f"{name} has {len(rows)} rows, t_s has {len(self.t_s)}; they must be equal")
        at = self.reference.position_m
        if self.reference.kind == "map" and (at is None or not isinstance(at[0], list) or len(at) != len(self.t_s)):
            raise ValueError("reference map needs position_m for every sample")
        if self.reference.kind == "map_point" and (at is None or isinstance(at[0], list)):
            raise ValueError("reference map_point needs one position_m, [x, y, z]")
        return self


class Stretch(BaseModel):
    start_s: float
    end_s: float


class AttitudeAnswer(BaseModel):
    """Orientations turn the device's axes to `frame`; angles are yaw, pitch, roll of 3-2-1, z up, with their sds."""

    frame: Annotated[
        Literal["building", "magnetic_north", "relative"],
        Field(description="relative: gravity is up, and yaw counts from the start"),
    ]
    t_s: list[float]
    orientation: Annotated[list[list[float]], Field(description="[w, x, y, z]")]
    yaw_rad: list[float]
    pitch_rad: list[float]
    roll_rad: list[float]
    yaw_sd_rad: list[float]
    pitch_sd_rad: list[float]
    roll_sd_rad: list[float]
    covariance_rad2: Annotated[
        list[list[list[float]]], Field(description="of the attitude's error about the device's axes")
    ]
    gyro_bias_rad_per_s: Annotated[list[float], Field(description="at the end")]
    magnetometer_used_share: Annotated[float | None, Field(description="null: it read nothing")]
    accelerometer_used_share: float
    disturbed: Annotated[list[Stretch], Field(description="where the field did not fit, and was not believed")]
    reference: Annotated[dict[str, Any], Field(description="what it was, with numbers")]
    calibration: AppliedView | None


@router.post("/attitudes", summary="Which way is the device turned?")
async def estimate(body: AttitudeQuery, context: ContextDep, identity: Measuring) -> AttitudeAnswer:
    """A multiplicative extended Kalman filter over the whole record (Kuevor 2023, chapter 3); nothing is stored. With
    reference `map` a phone's north is right indoors too, where a compass follows the steel."""
    return await run_in_threadpool(_estimate, context, identity, body)


def _estimate(context: Context, identity: Identity, body: AttitudeQuery) -> AttitudeAnswer:
    asked = body.reference
    at = None if asked.position_m is None else np.atleast_2d(np.asarray(asked.position_m, dtype=np.float64))
    with context.transaction() as session:
        calibration = find_calibration(session, identity.organisation_id, body.calibration_id, body.device)
    reference, told = find_reference(
        context.sessions, context.grids, identity.reach,
        AskedReference(
            asked.kind, asked.building_id, asked.floor_id, at, asked.position_sd_m, asked.horizontal_ut,
            asked.vertical_ut, asked.date or datetime.now(UTC).date(),
        ),
    )  # fmt: skip
    B_uT = _rows(body.magnetometer_ut or [None] * len(body.t_s))
    if calibration is not None:
        B_uT = calibration.model.apply(B_uT)
    samples = InertialSamples(
        np.asarray(body.t_s, dtype=np.float64), _rows(body.gyro_rad_per_s), _rows(body.accelerometer_m_per_s2), B_uT
    )
    if asked.kind != "none" and not np.isfinite(B_uT).any():
        reason = f"reference {asked.kind} is for a magnetometer, which has no reading here"
        raise InvalidInput(reason, Fault("/body/magnetometer_ut", "send its readings, or reference none"))
    run = estimate_attitude(samples, reference, _options(body, samples.t_s, at))
    return AttitudeAnswer(
        **_shown(run, samples, body.every),
        frame={"none": "relative", "learned": "relative", "level": "magnetic_north"}.get(asked.kind, "building"),  # type: ignore[arg-type]
        reference={"kind": asked.kind, **told},
        calibration=None if calibration is None else AppliedView(**calibration.told),
    )


def _rows(rows: list[ImuRow]) -> Array:
    """(n, 3), NaN where there is no sample."""
    nothing = [np.nan] * 3
    return np.array([nothing if row is None else row for row in rows], dtype=np.float64).reshape(-1, 3)


def _options(body: AttitudeQuery, t_s: Array, position_m: Array | None) -> AttitudeOptions:
    """What was told, and what suits the rest: a map leaves little field unexplained, and positions tell the speed."""
    told = {name.replace("_ut", "_uT"): value for name, value in body.options.model_dump(exclude_none=True).items()}
    suited: dict[str, Any] = {}
    if body.reference.kind == "map":
        assert position_m is not None
        suited = {"field_uT": MAPPED_FIELD_UT, "speed_m_per_s": _speed_m_per_s(t_s, position_m)}
    return AttitudeOptions(**(suited | told))


def _speed_m_per_s(t_s: Array, position_m: Array) -> float:
    """Root mean square over whole seconds, so that what jitters is not taken for speed; a walk's usual at least."""
    usual = AttitudeOptions().speed_m_per_s
    if t_s[-1] - t_s[0] < 1.0:
        return usual
    at = np.linspace(t_s[0], t_s[-1], min(int(t_s[-1] - t_s[0]) + 1, len(t_s)))
    place = np.stack([np.interp(at, t_s, position_m[:, k]) for k in (0, 1)], axis=1)
    moved = np.diff(place, axis=0) / (at[1] - at[0])
    return max(usual, float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))))


def _shown(run: AttitudeRun, samples: InertialSamples, every: int) -> dict[str, Any]:
    last = len(samples) - 1
    kept = np.unique(np.append(np.arange(0, last + 1, every), last))
    q, covariance = run.q_body_to_building[kept], run.covariance_rad2[kept]
    read = np.isfinite(samples.magnetometer_uT).all(axis=1)
    force = np.isfinite(samples.accelerometer_m_per_s2).all(axis=1)
    return {
        "t_s": samples.t_s[kept].tolist(),
        "orientation": q.tolist(),
        **{name: angle.tolist() for name, angle in euler_zyx_rad(q)._asdict().items()},
        **{
            name.replace("_rad2", "_sd_rad"): np.sqrt(variance).tolist()
            for name, variance in euler_zyx_variance_rad2(q, covariance)._asdict().items()
        },
        "covariance_rad2": covariance.tolist(),
        "gyro_bias_rad_per_s": run.gyro_bias_rad_per_s[-1].tolist(),
        "magnetometer_used_share": float(run.magnetometer_used[read].mean()) if read.any() else None,
        "accelerometer_used_share": float(run.accelerometer_used[force].mean()) if force.any() else 0.0,
        "disturbed": _stretches(samples.t_s[read], run.disturbed[read]),
    }


def _stretches(t_s: Array, disturbed: Any) -> list[dict[str, float]]:
    """Runs of disturbed readings."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], disturbed, [False]]).astype(np.int8)))
    return [
        {"start_s": float(t_s[a]), "end_s": float(t_s[b - 1])} for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]
