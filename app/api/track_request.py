"""What a client asks of a track: how it is to be followed, and the steps; and the same for the services."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import ConfigDict, Discriminator, Field, Tag, WithJsonSchema, model_validator

from app.api.attitudes import ImuRow
from app.api.locate_request import FloorId, Microtesla, OrientationFrame, PriorBody, Quaternion, Radians, Vector
from app.api.models import Finite, Name, RequestModel, Seconds
from app.errors import Fault, InvalidInput
from app.services.step_order import RawStep
from app.services.track_spec import StepKind
from app.survey.units import MAX_FIELD_UT, MIN_FIELD_UT, field_faults
from app.tracking.options import StartPrior, TrackOptions

__all__ = ["MOST_STEPS", "NewTrack", "StepBody", "StepsBody", "Frame", "core_options", "core_prior", "raw_steps"]

MOST_STEPS = 500
"""In one request, or message."""
MOST_INERTIAL = 500
"""Samples in one step."""
MOST_NUMBER = 2**53 - 1  # as far as JSON's numbers are whole everywhere
_UNIT_FROM = 10  # readings whose median may be judged

Frame = Literal["building", "level", "body", "norm"]
# A building is far smaller. The filter's spread grows with what was walked, and its work with its spread.
Displacement = Annotated[float, Field(allow_inf_nan=False, ge=-2000, le=2000)]


def _shape_of_field(value: object) -> str:
    return "vectors" if isinstance(value, list) else "magnitudes"


class InertialBody(RequestModel):
    """Samples of a device, null where a sensor has none; at rest the accelerometer reads +g upwards."""

    t_s: Annotated[list[Seconds], Field(min_length=1, max_length=MOST_INERTIAL)]
    gyro_rad_per_s: Annotated[list[ImuRow], Field(max_length=MOST_INERTIAL)]
    accelerometer_m_per_s2: Annotated[list[ImuRow], Field(max_length=MOST_INERTIAL)]
    magnetometer_ut: Annotated[list[ImuRow] | None, Field(max_length=MOST_INERTIAL)] = None

    @model_validator(mode="after")
    def _lengths_agree(self) -> Self:
        for name in ("gyro_rad_per_s", "accelerometer_m_per_s2", "magnetometer_ut"):
            rows = getattr(self, name)
            if rows is not None and len(rows) != len(self.t_s):
                raise ValueError(f"{name} has {len(rows)} rows, t_s has {len(self.t_s)}; they must be equal")
        if any(after <= before for before, after in pairwise(self.t_s)):
            raise ValueError("t_s has to increase from each sample to the next")
        return self


class TrackAttitude(RequestModel):
    """The track also follows how the device is turned, from `inertial` samples of its steps.

    map: against the map where the track believes it is, from when it has converged. wmm: against the Earth's field at
    the building's anchor. none: gyroscope and accelerometer; frame body with orientation_frame level may then leave
    orientation out of its steps.
    """

    reference: Literal["none", "wmm", "map"] = "map"


class StepBody(RequestModel):
    """One step. `displacement_m` is measured from the track's first step, in the track's frame."""

    number: Annotated[
        int, Field(ge=0, le=MOST_NUMBER, description="counts from 0; one that was followed is a duplicate")
    ]
    t_s: Annotated[Seconds, Field(description="seconds on any clock; does not decrease")]
    b_ut: Annotated[
        Annotated[Vector, Tag("vectors")] | Annotated[Microtesla, Tag("magnitudes")],
        Discriminator(_shape_of_field),
        Field(description="[bx, by, bz], of frame norm |B|; null: nothing was measured"),
    ] | None = None  # fmt: skip
    displacement_m: Annotated[
        Annotated[list[Displacement], Field(min_length=3, max_length=3)] | None,
        Field(description="null: the device does not know how it moves"),
    ] = None
    yaw_rad: Annotated[
        Annotated[float, Field(allow_inf_nan=False, ge=-1e4, le=1e4)] | None,
        Field(description="of the device since the first step; null: it turns with its path"),
    ] = None
    orientation: Annotated[
        Quaternion | None, Field(description="of frame body: the sensor's axes to orientation_frame, [w, x, y, z]")
    ] = None
    inertial: Annotated[
        InertialBody | None,
        Field(description="samples since the step before, in the sensor's axes, of a track with `attitude`"),
    ] = None
    heading_rad: Annotated[Radians | None, Field(description="yaw of the track's frame in the building, if known")] = (
        None
    )
    heading_sd_rad: Annotated[Finite, Field(ge=1e-4, le=10)] | None = None

    @model_validator(mode="after")
    def _pair(self) -> Self:
        if self.heading_sd_rad is not None and self.heading_rad is None:
            raise ValueError("heading_sd_rad says how sure heading_rad is; send both or neither")
        return self


_STEP: dict[str, Any] = {"number": 0, "t_s": 0.0, "b_ut": [19.8, 2.1, -43.0], "displacement_m": [0, 0, 0]}


class StepsBody(RequestModel):
    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"steps": [_STEP, {"number": 1, "t_s": 0.1, "b_ut": [19.6, 2.2, -43.1], "displacement_m": [0.1, 0, 0]}]}
            ]
        },
    )
    steps: Annotated[list[StepBody], Field(min_length=1, max_length=MOST_STEPS)]
    flush: Annotated[bool, Field(description="do not wait for numbers that are missing: give them up now")] = False


def _geojson(*kinds: str) -> WithJsonSchema:
    return WithJsonSchema({
        "type": "object",
        "description": f"a GeoJSON {' or '.join(kinds)} in building metres, for every floor; or one each, by floor id",
    })  # fmt: skip


class ConnectorBody(RequestModel):
    """Stairs or a lift: the floors it joins, and where it is on all of them."""

    kind: Literal["stairs", "lift"]
    floor_ids: Annotated[list[FloorId], Field(min_length=2, max_length=100)]
    polygon: Annotated[dict[str, Any], Field(description="a GeoJSON Polygon or MultiPolygon in building metres")]


def _positive(greatest: float, description: str) -> Any:
    return Field(default=None, gt=0, le=greatest, allow_inf_nan=False, description=description)


def _sd(greatest: float, description: str) -> Any:
    return Field(default=None, ge=0, le=greatest, allow_inf_nan=False, description=description)


class TrackOptionsBody(RequestModel):
    """What is known of the device and of the ground. What is left out has a default, which the track then shows."""

    noise_ut: float | None = _positive(1000, "sd of the sensor's white noise, per axis")
    bias_sd_ut: float | None = _sd(1000, "sd of the sensor's constant offset, per axis; of one never calibrated: 10")
    step_scale_sd: float | None = _sd(0.5, "relative sd of the displacements' scale")
    heading_drift_sd_rad_per_m: float | None = _sd(0.1, "sd of the rate by which the track's frame turns")
    heading_walk_rad: float | None = _sd(1.0, "sd of the heading's random walk, per square root of metre")
    position_walk_m: float | None = _sd(2.0, "sd of the position's random walk, per square root of metre")
    course_sd_rad: float | None = _sd(3.2, "sd of the direction walked about the one the device is held in")
    course_m: float | None = _positive(1000, "distance over which that direction stays alike")
    scale_m: float | None = _positive(10_000, "distance over which the displacements' scale stays alike")
    speed_m_s: float | None = _positive(10, "of a device that does not know how it moves: how fast it may be")
    particles: Annotated[int | None, Field(ge=100, le=50_000, description="most particles")] = None
    least_particles: Annotated[
        int | None, Field(ge=100, le=50_000, description="fewest; between the two, as many as the belief needs")
    ] = None
    update_m: float | None = _positive(5, "readings count once the device has moved this far")
    window_m: float | None = Field(
        default=None, ge=4, le=60, allow_inf_nan=False, description="length of what is searched for globally"
    )
    converged_probability: float | None = Field(default=None, ge=0.5, lt=1, description="for the state converged")
    lost_probability: float | None = Field(default=None, gt=0, lt=1, description="below it a converged track is lost")
    converged_radius_m: float | None = _positive(100, "that the belief lies within, for the state converged")
    lag_m: float | None = _positive(100, "distance walked after which a place is smoothed for good")
    walkable: Annotated[
        dict[str, Any] | None,
        _geojson("Polygon", "MultiPolygon"),
        Field(description="where one can walk; its edges are walls. Default: each floor's outline"),
    ] = None
    walls: Annotated[dict[str, Any] | None, _geojson("LineString", "MultiLineString")] = None
    connectors: Annotated[list[ConnectorBody], Field(max_length=200, default_factory=list)]


class NewTrack(RequestModel):
    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {"building_id": "01a2014f-5d0e-7a53-8f2c-6f2f3d1a9b10", "frame": "level",
                 "options": {"noise_ut": 0.5, "particles": 2000}}
            ]
        },
    )  # fmt: skip
    building_id: Annotated[FloorId | None, Field(description="every floor of it that has a map")] = None
    floor_ids: Annotated[list[FloorId] | None, Field(min_length=1, max_length=100)] = None
    frame: Annotated[
        Frame,
        Field(description="building: b and displacement in the building frame; level: both in the level frame of the "
              "first step, yaw unknown unless heading_rad is given; body: b in the sensor's axes with orientation, "
              "displacement in the frame that the orientation turns to; norm: b_ut is |B|, displacement in the level "
              "frame"),
    ]  # fmt: skip
    orientation_frame: Annotated[
        OrientationFrame,
        Field(description="of frame body, what orientation turns the sensor's axes to: building; level: the level "
              "frame of the first step (of a phone: its roll, pitch and gyroscope)"),
    ] = "building"  # fmt: skip
    calibration_id: Annotated[
        FloorId | None, Field(description="of frame body: the device's calibration, applied to b_ut of every step")
    ] = None
    device: Annotated[
        Name | None, Field(description="the same by name: its newest calibration, for the whole track")
    ] = None
    attitude: Annotated[TrackAttitude | None, Field(description="null: no attitude is followed")] = None
    options: Annotated[TrackOptionsBody, Field(default_factory=lambda: TrackOptionsBody.model_validate({}))]
    prior: Annotated[PriorBody | None, Field(description="where the first step is; null: anywhere")] = None
    seed: Annotated[int | None, Field(ge=0, le=MOST_NUMBER, description="of all that is drawn; default: a new one")] = (
        None
    )
    name: Name | None = None

    @model_validator(mode="after")
    def _somewhere(self) -> Self:
        if self.building_id is None and self.floor_ids is None:
            raise ValueError("say where: building_id, or floor_ids")
        if self.frame != "body" and (self.calibration_id is not None or self.device is not None):
            raise ValueError("a calibration is of the sensor's own axes: use frame body, b_ut uncorrected, orientation")
        if self.frame != "body" and self.orientation_frame != "building":
            raise ValueError("orientation_frame is of frame body")
        return self


def core_options(body: TrackOptionsBody) -> TrackOptions:
    """The options of the core, without the ground."""
    told = body.model_dump(exclude_none=True, exclude={"walkable", "walls", "connectors"})
    named = {"noise_uT" if name == "noise_ut" else "bias_sd_uT" if name == "bias_sd_ut" else name: value
             for name, value in told.items()}  # fmt: skip
    options = TrackOptions(**named)
    return replace(options, least_particles=min(options.least_particles, options.particles))


def core_prior(body: PriorBody | None) -> StartPrior | None:
    return None if body is None else StartPrior((*body.position_m,), body.sd_m)  # type: ignore[arg-type]


def raw_steps(body: StepsBody, kind: StepKind) -> list[RawStep]:
    """Steps as they are stored and followed, checked as far as that goes without the others.

    Raises InvalidInput, with the place of each fault.
    """
    faults = [fault for index, step in enumerate(body.steps) for fault in _shape_faults(step, kind, index)]
    if faults:
        raise InvalidInput(faults[0].reason, *faults[:50])
    steps = [step.model_dump(exclude_none=True) for step in body.steps]
    _check_field(steps)
    return steps


def _shape_faults(step: StepBody, kind: StepKind, index: int) -> list[Fault]:
    frame = kind.frame
    where = f"/body/steps/{index}"
    faults = []
    if step.b_ut is not None and isinstance(step.b_ut, list) == (frame == "norm"):
        faults.append(
            Fault(f"{where}/b_ut", f"in frame {frame} b_ut is {'|B|' if frame == 'norm' else '[bx, by, bz]'}")
        )
    if step.inertial is not None and not kind.attitude:
        faults.append(Fault(f"{where}/inertial", "this track follows no attitude; make it with `attitude`"))
    turned = step.orientation is not None or (kind.own_orientation and step.inertial is not None)
    if frame == "body" and step.b_ut is not None and not turned:
        faults.append(
            Fault(f"{where}/orientation", "frame body needs it: [w, x, y, z], the sensor's axes to orientation_frame")
        )
    if step.orientation is not None and frame != "body":
        faults.append(Fault(f"{where}/orientation", f"of frame body only; this track is in frame {frame}"))
    if step.orientation is not None and abs(float(np.linalg.norm(step.orientation)) - 1.0) > 0.1:
        faults.append(Fault(f"{where}/orientation", f"its norm is {np.linalg.norm(step.orientation):.3g}, not 1"))
    return faults


def _check_field(steps: Sequence[Mapping[str, Any]]) -> None:
    """Raise InvalidInput for readings outside what a sensor can read, or in another unit.

    Few readings may well be beside a magnet: their unit is judged by the track's first step, or by many of them.
    """
    at = [index for index, step in enumerate(steps) if step.get("b_ut") is not None]
    norm_uT = np.array([np.linalg.norm(steps[index]["b_ut"]) for index in at])
    judged = len(at) >= _UNIT_FROM or (len(at) > 0 and steps[at[0]]["number"] == 0)
    if not judged:
        outside = (norm_uT < MIN_FIELD_UT) | (norm_uT > MAX_FIELD_UT)
        at = [index for index, bad in zip(at, outside, strict=True) if bad]
        norm_uT = norm_uT[outside]
    if not at:
        return
    message, faults = field_faults(norm_uT, lambda reading: f"/body/steps/{at[reading]}/b_ut")
    if message is not None:
        raise InvalidInput(f"{message}; send null where the sensor was saturated", *faults)
