"""The Earth's field at a building's anchor, and what is told of the model wherever it was the reference."""

from datetime import date
from typing import Any

from sqlalchemy.orm import Session

from app.db.tables import Building
from app.earth_field import EarthField, earth_field
from app.errors import Fault, InvalidInput, NotFound
from app.geodesy import Anchor
from app.services.reach import Reach

__all__ = ["earth_at_building", "told_model"]


def earth_at_building(
    session: Session, reach: Reach, building_id: str, on: date, location: str = "building_id"
) -> tuple[EarthField, Anchor]:
    """Raises NotFound, and InvalidInput, at `location`, for a building that has no anchor."""
    building = session.get(Building, building_id)
    if building is None or not reach.holds(building.organisation_id, building.id):
        raise NotFound(f"no building {building_id}")
    if building.anchor is None:
        reason = f"building {building_id} has no anchor: PATCH its latitude, longitude, height and bearing first"
        raise InvalidInput(reason, Fault(location, reason))
    anchor = Anchor(**building.anchor)
    return earth_field(anchor.latitude_deg, anchor.longitude_deg, anchor.height_m, on), anchor


def told_model(field: EarthField) -> dict[str, Any]:
    """As JSON: which model, of which date, and whether that lies in its five years."""
    return {"model": field.model, "date": field.on.isoformat(), "valid": field.valid}
