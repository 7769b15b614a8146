"""How much an organisation may keep. Checked in the transaction that adds to it, after the row was added; what surveys
the whole organisation has, before a new one's file is read.

What is sent at once may pass a limit of the organisation together, by as many as there are.
"""

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Select, func, or_, select
from sqlalchemy.orm import Session

from app.db.tables import Building, Floor, Key, Survey, utc_now
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
    keys: int

    def check_buildings(self, session: Session, organisation_id: str) -> None:
        """Raises QuotaExceeded, as all of these."""
        there = select(func.count()).select_from(Building).where(Building.organisation_id == organisation_id)
        _within(session, there, self.buildings, "this organisation has {most} buildings, the most it may have")

    def check_keys(self, session: Session, organisation_id: str) -> None:
        """Those that have not ended. Subjects of an identity provider are its business, and not counted."""
        lives = or_(Key.expires_at.is_(None), Key.expires_at > utc_now())
        there = (
            select(func.count())
            .select_from(Key)
            .where(Key.organisation_id == organisation_id, Key.subject.is_(None), Key.revoked_at.is_(None), lives)
        )
        told = "this organisation has {most} keys that have not ended, the most it may have; revoke some"
        _within(session, there, self.keys, told)

    def check_floors(self, session: Session, building_id: str) -> None:
        there = select(func.count()).select_from(Floor).where(Floor.building_id == building_id)
        _within(session, there, self.floors_per_building, "this building has {most} floors, the most it may have")

    def check_surveys_of_floor(self, session: Session, floor_id: str, coming: int = 0) -> None:
        """Also when none was added yet, but some are `coming`, before their files are read."""
        there = select(func.count()).select_from(Survey).where(Survey.floor_id == floor_id)
        told = "this floor has {most} surveys, the most it may have; delete some, or leave out what is old"
        _within(session, there, self.surveys_per_floor, told, coming)

    def check_surveys(self, session: Session, organisation_id: str, coming: int = 0, coming_bytes: int = 0) -> None:
        """Reads the index entries of all surveys of the organisation: once an upload."""
        there = select(func.count(), func.sum(Survey.raw_bytes)).where(Survey.organisation_id == organisation_id)
        count, size = session.execute(there).one()
        if count + coming > self.surveys:
            raise _exceeded("this organisation has {most} surveys, the most it may have; delete some", self.surveys)
        if (size or 0) + coming_bytes > self.survey_bytes:
            told = "the survey files of this organisation would be more than {most} bytes; delete some"
            raise _exceeded(told, self.survey_bytes)


def _within(session: Session, there: Select[Any], most: int, told: str, coming: int = 0) -> None:
    if session.scalars(there).one() + coming > most:
        raise _exceeded(told, most)


def _exceeded(told: str, most: int) -> QuotaExceeded:
    return QuotaExceeded(told.format(most=f"{most:,}") + ", or have the limit raised")
