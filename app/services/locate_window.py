"""Locate a window: the active maps of the candidate floors (one statement), the search, the fix. Nothing is written."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from time import perf_counter

from sqlalchemy import Connection, Select, bindparam, select

from app.db.tables import Floor, Map
from app.errors import NotFound
from app.positioning.explanation import Explanation
from app.positioning.fix import Fix, LocateOptions, Prior
from app.positioning.locate import locate_and_explain
from app.positioning.window import Composition, Window
from app.services.grid_cache import GridCache
from app.services.reach import Reach

__all__ = ["ActiveMap", "LocateResult", "active_maps", "locate_window"]


@dataclass(frozen=True, slots=True)
class ActiveMap:
    """The map a floor answers with now."""

    floor_id: str
    map_id: str
    grid_sha256: str


@dataclass(frozen=True, slots=True)
class LocateResult:
    """A fix, the maps it was found in, and the time the search took."""

    fix: Fix
    map_ids: tuple[str, ...]
    search_ms: float
    explanation: Explanation | None = None


def active_maps(
    connection: Connection,
    reach: Reach,
    *,
    building_id: str | None = None,
    floor_ids: Sequence[str] | None = None,
) -> list[ActiveMap]:
    """The active maps of a building's floors, or of the floors named. Raises NotFound for a named floor that is not
    within reach; a floor without a map is simply not among them."""
    asked = {
        "organisation_id": reach.organisation_id, "building_id": building_id, "floor_ids": floor_ids,
        "within": reach.building_ids,
    }  # fmt: skip
    statement = _active_maps(building_id is not None, floor_ids is not None, reach.building_ids is not None)
    rows = connection.execute(statement, {name: value for name, value in asked.items() if value is not None}).all()
    for missing in sorted(set(floor_ids or ()) - {row[0] for row in rows}):
        raise NotFound(f"no floor {missing}" + (" in this building" if building_id else ""))
    return [ActiveMap(floor_id, map_id, sha256) for floor_id, map_id, sha256 in rows if map_id and sha256]


@cache
def _active_maps(of_building: bool, of_floors: bool, limited: bool) -> Select[str, str | None, str | None]:
    """The statement, made once: to put it together costs several times what it takes to execute."""
    statement: Select[str, str | None, str | None] = (
        select(Floor.id, Map.id, Map.grid_sha256)
        .join(Map, Map.id == Floor.active_map_id, isouter=True)
        .where(Floor.organisation_id == bindparam("organisation_id"))
        .order_by(Floor.ordinal, Floor.id)
    )
    if of_building:
        statement = statement.where(Floor.building_id == bindparam("building_id"))
    if of_floors:
        statement = statement.where(Floor.id.in_(bindparam("floor_ids", expanding=True)))
    if limited:
        statement = statement.where(Floor.building_id.in_(bindparam("within", expanding=True)))
    return statement


def locate_window(
    maps: Sequence[ActiveMap],
    cache: GridCache,
    window: Window,
    *,
    composition: Composition,
    techniques: Sequence[str],
    prior: Prior | None,
    options: LocateOptions,
    explained: bool = False,
) -> LocateResult:
    """Match a window against maps. Raises InvalidWindow, IncompatibleFrames."""
    floors = cache.searchable([(each.floor_id, each.grid_sha256) for each in maps])
    start = perf_counter()
    fix, explanation = locate_and_explain(
        window, floors, composition=composition, techniques=techniques, prior=prior, options=options,
        explained=explained,
    )  # fmt: skip
    search_ms = 1e3 * (perf_counter() - start)
    return LocateResult(fix, tuple(each.map_id for each in maps), search_ms, explanation)
