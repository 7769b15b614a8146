"""How much an organisation may keep. Checked in the transaction that adds to it, after the row was added.

Uploads of one organisation to several floors at once may pass the limit together, by as many as there are.
"""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from app.db.tables import Building, Floor, Survey
from app.errors import QuotaExceeded

__all__ = ["Quotas"]


@dataclass(frozen=True, slots=True)
class Quotas:
    """The most of everything, per organisation but where it says otherwise."""

    buildings: int
    floors_per_building: int
    surveys: int
    surveys_per_floor: int
    survey_bytes: int

    def check_buildings(self, session: Session, organisation_id: str) -> None:
        """Raises QuotaExceeded, as all of these."""
        there = select(func.count()).select_from(Building).where(Building.organisation_id == organisation_id)
        _within(session, there, self.buildings, "this organisation has {most} buildings, the most it may have")

    def check_floors(self, session: Session, building_id: str) -> None:
        there = select(func.count()).select_from(Floor).where(Floor.building_id == building_id)
        _within(session, there, self.floors_per_building, "this building has {most} floors, the most it may have")

    def check_surveys(self, session: Session, floor: Floor, coming: int = 0) -> None:
        """Also when none was added yet, but one is `coming`, before its file is read."""
        of_floor = select(func.count()).select_from(Survey).where(Survey.floor_id == floor.id)
        told = "this floor has {most} surveys, the most it may have; delete some, or leave out what is old"
        _within(session, of_floor, self.surveys_per_floor - coming, told, self.surveys_per_floor)
        own = Survey.organisation_id == floor.organisation_id
        count = select(func.count()).select_from(Survey).where(own)
        told = "this organisation has {most} surveys, the most it may have; delete some"
        _within(session, count, self.surveys - coming, told, self.surveys)
        size = select(func.coalesce(func.sum(Survey.raw_bytes), 0)).where(own)
        told = "the survey files of this organisation would be more than {most} bytes; delete some"
        _within(session, size, self.survey_bytes - coming, told, self.survey_bytes)


def _within(session: Session, there: Select[Any], limit: int, told: str, most: int | None = None) -> None:
    if session.scalars(there).one() > limit:
        raise QuotaExceeded(told.format(most=f"{limit if most is None else most:,}") + ", or have the limit raised")
