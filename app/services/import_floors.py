"""Import a building's floors: the levels of an indoor map make the floors that are missing and outline the others."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app.db.tables import Building, Floor
from app.errors import Conflict
from app.outline.levels import Level

__all__ = ["ImportedFloors", "import_floors"]


@dataclass(slots=True)
class ImportedFloors:
    """Every floor that a level was for: new, with another outline than before, or as it was."""

    made: list[Floor] = field(default_factory=list)
    changed: list[Floor] = field(default_factory=list)
    unchanged: list[Floor] = field(default_factory=list)


def import_floors(
    session: Session, building: Building, levels: Sequence[Level], storey_height_m: float
) -> ImportedFloors:
    """Make or outline one floor per level, in the caller's transaction; a new one lies at ordinal times storey height.

    Floors are matched by ordinal, and keep name and elevation. The building is locked first, so that two imports at
    once make every floor once. Raises Conflict where several floors have the ordinal of a level.
    """
    session.execute(update(Building).where(Building.id == building.id).values(name=Building.name))
    there = _by_ordinal(session, building, {level.ordinal for level in levels})
    imported = ImportedFloors()
    for level in levels:
        floor = there.get(level.ordinal)
        if floor is None:
            imported.made.append(_new_floor(building, level, storey_height_m))
        elif floor.outline == level.outline:
            imported.unchanged.append(floor)
        else:
            floor.outline = dict(level.outline)
            imported.changed.append(floor)
    session.add_all(imported.made)
    session.flush()
    return imported


def _by_ordinal(session: Session, building: Building, wanted: set[int]) -> dict[int, Floor]:
    """The floor of every ordinal that is wanted and there. Raises Conflict for two of one ordinal."""
    there: dict[int, Floor] = {}
    of_levels = select(Floor).where(Floor.building_id == building.id, Floor.ordinal.in_(wanted))
    for floor in session.scalars(of_levels.order_by(Floor.id).execution_options(populate_existing=True)):
        other = there.setdefault(floor.ordinal, floor)
        if other is not floor:
            both = f"floors {other.id} and {floor.id} both have the ordinal {floor.ordinal}"
            raise Conflict(f"{both}; change one, or give each its outline by itself")
    return there


def _new_floor(building: Building, level: Level, storey_height_m: float) -> Floor:
    return Floor(
        organisation_id=building.organisation_id,
        building_id=building.id,
        name=level.name,
        ordinal=level.ordinal,
        elevation_m=level.ordinal * storey_height_m,
        outline=dict(level.outline),
    )
