"""What a client sends to have a device calibrated; and how a calibration is named wherever readings come in."""

from datetime import UTC, datetime
from datetime import date as Date
from typing import Annotated, Literal, Self

import numpy as np
from fastapi import Query
from pydantic import ConfigDict, Field, model_validator

from app.api.locate_request import FloorId, Quaternion, Vector
from app.api.models import Finite, Name, Point, RequestModel, Time
from app.services.calibrate import CIRCLE_METHODS, Asked, MappedWalk, Place

__all__ = ["CalibrationId", "DeviceQuery", "Method", "NewCalibration"]

MOST_READINGS = 50_000
MOST_WALKED = 5_000
"""Readings of a walk that is searched for."""
Method = Literal["two_step", "ellipsoid", "modified_ellipsoid", "strict_ellipse", "swinging", "map_aided"]

CalibrationId = Annotated[
    str | None,
    Query(
        max_length=64,
        pattern=r"^[A-Za-z0-9_-]+$",
        description="a calibration of the device, applied to its readings",
        examples=["0197c1a2-0b7e-7c3d-9a52-5f0e8d6b4c21"],
    ),
]
DeviceQuery = Annotated[
    Name | None, Query(description="the same by name: its newest calibration", examples=["robot-7"])
]


class ReferenceBody(RequestModel):
    """The Earth's field where the readings were taken: as it is, or by place and date (the World Magnetic Model)."""

    magnitude_ut: Annotated[Finite | None, Field(gt=5, lt=150)] = None
    horizontal_ut: Annotated[Finite | None, Field(gt=0.5, lt=150)] = None
    vertical_ut: Annotated[
        Finite | None, Field(ge=-150, le=150, description="along the sensor's +z while it is turned level")
    ] = None
    latitude_deg: Annotated[Finite | None, Field(ge=-90, le=90)] = None
    longitude_deg: Annotated[Finite | None, Field(ge=-180, le=180)] = None
    height_m: Annotated[Finite, Field(ge=-1000, le=10_000, description="above the WGS 84 ellipsoid")] = 0.0
    building_id: Annotated[FloorId | None, Field(description="instead of a place: outside of this building")] = None
    date: Annotated[Date | None, Field(description="default: that of measured_at")] = None
    z_axis: Annotated[
        Literal["up", "down"], Field(description="where the sensor's z points while it is turned level")
    ] = "up"

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.latitude_deg is None) != (self.longitude_deg is None):
            raise ValueError("a place is latitude_deg and longitude_deg: send both, or magnitude_ut instead")
        if self.building_id is not None and self.latitude_deg is not None:
            raise ValueError("send building_id or a latitude and longitude, not both")
        return self


class WalkBody(RequestModel):
    """A walk through a mapped building, for method map_aided: a row for each reading.

    With position_m, where it was is told. Without, the map finds it: then displacement_m and orientation are in the
    level frame of the first reading, and 40 to 100 m with turns serve best.
    """

    floor_id: Annotated[FloorId | None, Field(description="the floor it was on")] = None
    building_id: Annotated[FloorId | None, Field(description="instead, without position_m: any floor of it")] = None
    orientation: Annotated[
        list[Quaternion],
        Field(max_length=MOST_READINGS, description="[w, x, y, z], the sensor's axes to the building, or the level "
              "frame of the first reading"),
    ]  # fmt: skip
    position_m: Annotated[list[Point] | None, Field(max_length=MOST_READINGS, description="in the building frame")] = (
        None
    )
    position_sd_m: Annotated[Finite, Field(ge=0, le=20)] = 0.3
    displacement_m: Annotated[
        list[Point] | None, Field(max_length=MOST_WALKED, description="from the first reading")
    ] = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if (self.position_m is None) == (self.displacement_m is None):
            raise ValueError("send position_m, or displacement_m where nobody knows where it was")
        if (self.floor_id is None) == (self.building_id is None):
            raise ValueError("send floor_id, or building_id where nobody knows the floor")
        if self.position_m is not None and self.floor_id is None:
            raise ValueError("position_m is on a floor: send floor_id")
        return self

    @property
    def way(self) -> list[list[float]]:
        told = self.position_m if self.position_m is not None else self.displacement_m
        assert told is not None
        return told


class NewCalibration(RequestModel):
    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "device": "robot-7",
                    "method": "two_step",
                    "reference": {"latitude_deg": 48.1403, "longitude_deg": 11.5583, "height_m": 570.0},
                    "b_ut": [[21.9, -3.1, -41.8], [24.5, 9.8, -38.0], [-19.2, 4.0, 42.7]],
                }
            ]
        },
    )
    device: Annotated[Name, Field(description="a name for it; its calibrations are counted")]
    method: Annotated[
        Method,
        Field(description="two_step, ellipsoid: turned through all directions. modified_ellipsoid, strict_ellipse, "
              "swinging: turned level, in circles. map_aided: walked through a mapped building"),
    ] = "two_step"  # fmt: skip
    b_ut: Annotated[
        list[Vector],
        Field(min_length=2, max_length=MOST_READINGS, description="readings in the sensor's own axes, uncalibrated"),
    ]
    reference: ReferenceBody | None = None
    walk: WalkBody | None = None
    measured_at: Annotated[Time | None, Field(description="default: now")] = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.method == "map_aided":
            if self.walk is None:
                raise ValueError("map_aided needs walk: where the device was, and how it was held")
            if not len(self.walk.orientation) == len(self.walk.way) == len(self.b_ut):
                raise ValueError("walk has as many orientations and places as there are readings in b_ut")
            return self
        if self.walk is not None:
            raise ValueError("walk is for method map_aided")
        told = self.reference
        if told is None:
            raise ValueError("say by reference what the Earth's field was: its magnitude, or the place")
        placed = told.building_id is not None or told.latitude_deg is not None
        if self.method in CIRCLE_METHODS:
            if not placed and (told.horizontal_ut is None or told.vertical_ut is None):
                raise ValueError(f"{self.method} needs reference: horizontal_ut and vertical_ut, or the place")
        elif not placed and told.magnitude_ut is None:
            raise ValueError(f"{self.method} needs reference: magnitude_ut, or the place")
        return self

    def asked(self) -> Asked:
        """The same for the service."""
        told = self.reference
        place = walk = None
        if told is not None and (told.building_id is not None or told.latitude_deg is not None):
            on = told.date or (self.measured_at or datetime.now(UTC)).date()
            place = Place(told.building_id, told.latitude_deg, told.longitude_deg, told.height_m, on, told.z_axis)
        if self.walk is not None:
            walk = MappedWalk(
                floor_id=self.walk.floor_id,
                building_id=self.walk.building_id,
                q=np.asarray(self.walk.orientation, dtype=np.float64),
                way_m=np.asarray(self.walk.way, dtype=np.float64),
                known=self.walk.position_m is not None,
                position_sd_m=self.walk.position_sd_m,
            )
        return Asked(
            method=self.method,
            B_uT=np.asarray(self.b_ut, dtype=np.float64),
            magnitude_uT=None if told is None else told.magnitude_ut,
            horizontal_uT=None if told is None else told.horizontal_ut,
            vertical_uT=None if told is None else told.vertical_ut,
            place=place,
            walk=walk,
        )
