"""One organisation's view of the source: every question it asks carries that organisation and no other."""

import threading
from collections import OrderedDict

from app.field.grid import FieldGrid
from app.viewer.source import ViewedBuilding, ViewerSource, Walk

__all__ = ["GridCache", "OrganisationContent"]


class GridCache:
    """The grids shown lately, up to `max_bytes` in all. Maps never change, so nothing here grows stale."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._grids: OrderedDict[tuple[str, str], FieldGrid] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, source: ViewerSource, organisation_id: str, map_id: str) -> FieldGrid:
        key = (organisation_id, map_id)
        with self._lock:
            if key in self._grids:
                self._grids.move_to_end(key)
                return self._grids[key]
        grid = source.grid(organisation_id, map_id)
        with self._lock:
            self._grids[key] = grid
            while len(self._grids) > 1 and sum(g.nbytes for g in self._grids.values()) > self._max_bytes:
                self._grids.popitem(last=False)
        return grid


class OrganisationContent:
    """What one organisation's viewer can reach: there is no way to name another's object here."""

    def __init__(self, organisation_id: str, source: ViewerSource, grids: GridCache) -> None:
        self._organisation_id = organisation_id
        self._source = source
        self._grids = grids

    def buildings(self) -> list[ViewedBuilding]:
        return self._source.buildings(self._organisation_id)

    def grid(self, map_id: str) -> FieldGrid:
        return self._grids.get(self._source, self._organisation_id, map_id)

    def walks(self, floor_id: str) -> list[Walk]:
        return self._source.walks(self._organisation_id, floor_id)

    def plan_image(self, floor_id: str) -> bytes:
        return self._source.plan_image(self._organisation_id, floor_id)
