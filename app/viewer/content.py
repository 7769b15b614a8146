"""What somebody reaches of the source: every question it asks carries that reach and no other."""

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.services.reach import Reach
from app.viewer.layers import difference_uT, layer_values
from app.viewer.pointing import walk_residuals
from app.viewer.scene import plan_picture
from app.viewer.source import ViewedBuilding, ViewedFloor, ViewedMap, ViewerSource, Walk

__all__ = ["OrganisationContent", "RecentlyUsed"]


class Weighed(Protocol):
    @property
    def nbytes(self) -> int: ...


Value = TypeVar("Value", bound=Weighed)


class RecentlyUsed:
    """What was used lately, up to `max_bytes` in all: maps, their layers, walks. Nothing here grows stale: maps never
    change, nor do surveys."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._held: OrderedDict[Hashable, Weighed] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, kind: type[Value], make: Callable[[], Value]) -> Value:
        """The value under a key, made when it is not there."""
        with self._lock:
            held = self._held.get(key)
            if isinstance(held, kind):
                self._held.move_to_end(key)
                return held
        value = make()
        self.put(key, value)
        return value

    def peek(self, key: Hashable, kind: type[Value]) -> Value | None:
        with self._lock:
            held = self._held.get(key)
        return held if isinstance(held, kind) else None

    def put(self, key: Hashable, value: Weighed) -> None:
        """Hold a value, and let go of what was used longest ago until all fits."""
        with self._lock:
            self._held[key] = value
            self._held.move_to_end(key)
            while len(self._held) > 1 and sum(each.nbytes for each in self._held.values()) > self._max_bytes:
                self._held.popitem(last=False)

    @property
    def nbytes(self) -> int:
        with self._lock:
            return sum(each.nbytes for each in self._held.values())


@dataclass(frozen=True, slots=True, eq=False)
class _Walks:
    by_survey: dict[str, Walk]

    @property
    def nbytes(self) -> int:
        return sum(
            w.samples.B_uT.nbytes + w.p_building_m.nbytes + w.samples.t_s.nbytes for w in self.by_survey.values()
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Residuals:
    each: tuple[Array, ...]

    @property
    def nbytes(self) -> int:
        return sum(residual.nbytes for residual in self.each)


class OrganisationContent:
    """What one organisation's viewer, or one of some of its buildings, can reach: no other object has a name here."""

    def __init__(self, reach: Reach, source: ViewerSource, recent: RecentlyUsed) -> None:
        self._reach = reach
        self._source = source
        self._recent = recent

    def buildings(self) -> list[ViewedBuilding]:
        return self._source.buildings(self._reach)

    def map(self, map_id: str) -> ViewedMap:
        """Raises NotFound."""
        key = (self._reach, "map", map_id)
        return self._recent.get(key, ViewedMap, lambda: self._source.map(self._reach, map_id))

    def layer(self, map_id: str, layer: str, height_index: int, versus_id: str | None = None) -> Array:
        """One layer of a map at one height, (ny, nx); `difference` is the one to the map `versus_id`.

        Raises NotFound, InvalidInput.
        """

        def make() -> Array:
            shown = self.map(map_id)
            stored = dict(shown.stored)
            if layer == "difference" and versus_id is not None:
                stored["difference"] = difference_uT(shown.grid, self.map(versus_id).grid)
            return layer_values(shown.grid, layer, height_index, stored)

        key = (self._reach, "layer", map_id, layer, height_index, versus_id)
        return self._recent.get(key, np.ndarray, make)

    def walks(self, floor_id: str) -> list[Walk]:
        """Raises NotFound."""
        key = (self._reach, "walks", floor_id)
        known = self._recent.peek(key, _Walks)
        walks = self._source.walks(self._reach, floor_id, known.by_survey if known else {})
        self._recent.put(key, _Walks({walk.survey_id: walk for walk in walks}))
        return walks

    def residuals_uT(self, map_id: str, walks: Sequence[Walk]) -> tuple[Array, ...]:
        """(n,) of each walk, what it measured less the map (`walk_residuals`). Raises NotFound."""
        key = (self._reach, "residuals", map_id, *(walk.survey_id for walk in walks))
        return self._recent.get(key, _Residuals, lambda: _Residuals(walk_residuals(self.map(map_id).grid, walks))).each

    def plan(self, floor: ViewedFloor) -> NDArray[np.uint8]:
        """The picture of a floor's plan (rows, columns, 3), as large as it is drawn. Raises NotFound."""
        key = (self._reach, "plan", floor.id, floor.plan.sha256 if floor.plan else None)

        def make() -> NDArray[np.uint8]:
            return plan_picture(self._source.plan_image(self._reach, floor.id))

        return self._recent.get(key, np.ndarray, make)
