"""What the Earth's field is at a place and date, by the World Magnetic Model; and at a building, in its own frame."""

from datetime import UTC, datetime
from datetime import date as Date
from math import degrees
from typing import Annotated

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from app.api.auth import Measuring
from app.api.context import ContextDep
from app.api.models import Finite
from app.api.problems import ERROR_RESPONSES
from app.earth_field import EarthField, earth_field, field_in_building_uT
from app.errors import Fault, InvalidInput
from app.geodesy import Anchor
from app.services.earth_reference import earth_at_building

__all__ = ["ReferenceFieldView", "router", "show_reference_field"]

router = APIRouter(prefix="/v1", tags=["calibration"], responses=ERROR_RESPONSES)


class ReferenceFieldView(BaseModel):
    """North, east and down; sds are of what the model leaves out outdoors (crust, magnetic storms), steel excluded."""

    model: str = Field(examples=["WMM-2025"])
    date: Date
    valid: Annotated[bool, Field(description="whether the date lies in the model's five years")]
    valid_from: Date
    valid_until: Date
    latitude_deg: float
    longitude_deg: float
    height_m: Annotated[float, Field(description="above the WGS 84 ellipsoid")]
    north_ut: float
    east_ut: float
    down_ut: float
    horizontal_ut: float
    magnitude_ut: float
    declination_deg: Annotated[float, Field(description="of magnetic north from true north, eastward")]
    inclination_deg: Annotated[float, Field(description="of the field below the horizon")]
    horizontal_sd_ut: float
    down_sd_ut: float
    magnitude_sd_ut: float
    yearly_change_ut: Annotated[list[float], Field(description="of north, east and down")]
    compass: Annotated[bool, Field(description="whether the horizontal field is strong enough for a compass")]
    building_ut: Annotated[
        list[float] | None, Field(description="[x, y, z up] in the building frame; null without a building")
    ] = None


@router.get("/reference-field", summary="The Earth's field at a place, or at a building's anchor")
def get_reference_field(
    context: ContextDep,
    identity: Measuring,
    latitude_deg: Annotated[Finite | None, Query(ge=-90, le=90, examples=[48.1403])] = None,
    longitude_deg: Annotated[Finite | None, Query(ge=-180, le=180, examples=[11.5583])] = None,
    height_m: Annotated[
        Finite,
        Query(ge=-1000, le=850_000,
              description="above the WGS 84 ellipsoid: of a height above sea level, add the geoid's undulation there"),
    ] = 0.0,
    building_id: Annotated[
        str | None,
        Query(max_length=64, pattern=r"^[A-Za-z0-9_-]+$", description="instead of a place: its anchor"),
    ] = None,
    date: Annotated[Date | None, Query(description="default: today, UTC", examples=["2026-03-02"])] = None,
) -> ReferenceFieldView:  # fmt: skip
    """By the World Magnetic Model of the date (NOAA/NCEI and BGS). What the calibrations of a sensor are measured
    against, what surveys are checked against, and an attitude's reference where there is no map."""
    on = date or datetime.now(UTC).date()
    if building_id is not None:
        if latitude_deg is not None or longitude_deg is not None:
            reason = "give a building_id or a latitude and longitude, not both"
            raise InvalidInput(reason, Fault("/query/building_id", reason))
        with context.transaction() as session:
            field, anchor = earth_at_building(session, identity.reach, building_id, on, "/query/building_id")
        return show_reference_field(field, anchor, in_building=True)
    if latitude_deg is None or longitude_deg is None:
        reason = "say where: latitude_deg and longitude_deg, or building_id"
        raise InvalidInput(reason, Fault("/query/latitude_deg", reason))
    anchor = Anchor(latitude_deg, longitude_deg, height_m, 0.0)
    return show_reference_field(earth_field(latitude_deg, longitude_deg, height_m, on), anchor, in_building=False)


def show_reference_field(field: EarthField, anchor: Anchor, *, in_building: bool) -> ReferenceFieldView:
    return ReferenceFieldView.model_validate(
        {
            "model": field.model,
            "date": field.on,
            "valid": field.valid,
            "valid_from": field.valid_from,
            "valid_until": field.valid_until,
            "latitude_deg": anchor.latitude_deg,
            "longitude_deg": anchor.longitude_deg,
            "height_m": anchor.height_m,
            "north_ut": field.north_uT,
            "east_ut": field.east_uT,
            "down_ut": field.down_uT,
            "horizontal_ut": field.horizontal_uT,
            "magnitude_ut": field.magnitude_uT,
            "declination_deg": degrees(field.declination_rad),
            "inclination_deg": degrees(field.inclination_rad),
            "horizontal_sd_ut": field.horizontal_sd_uT,
            "down_sd_ut": field.down_sd_uT,
            "magnitude_sd_ut": field.magnitude_sd_uT,
            "yearly_change_ut": list(field.yearly_change_uT),
            "compass": field.compass,
            "building_ut": field_in_building_uT(field, anchor).tolist() if in_building else None,
        }
    )
