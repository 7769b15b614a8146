"""Maps held ready to answer: an LRU of grids and searchable floors, bounded by bytes, keyed by content hash."""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from threading import Lock
from time import monotonic

from app.blobs import BlobStore
from app.field.grid import FieldGrid
from app.geometry import Array
from app.positioning.locate import SearchableFloor, prepare_floor, shared_noise_sd_uT
from app.services.artefacts import grid_from_bytes
from app.telemetry.metrics import (
    MAP_CACHE_BYTES,
    MAP_CACHE_EVICTIONS,
    MAP_CACHE_LOAD_SECONDS,
    MAP_CACHE_LOOKUPS,
)

__all__ = ["GridCache"]

_Entry = FieldGrid | SearchableFloor
_Key = tuple[str, str, bytes]  # floor id ("": the grid itself), hash of the grid, noise of the floor (b"": its own)

IN_USE_S = 600.0
"""Floors that were searched this lately have their next map made ready before it is asked for."""
MOST_IN_USE = 1000


class GridCache:
    """A grid never changes under its hash, so an entry never goes stale; the least recently used is dropped when full.

    A grid is held once, however many floors were prepared from it: alone, and under each noise shared with others.
    """

    def __init__(self, blobs: BlobStore, capacity_bytes: int) -> None:
        self._blobs = blobs
        self._capacity_bytes = capacity_bytes
        self._entries: OrderedDict[_Key, _Entry] = OrderedDict()
        self._loading: dict[_Key, Future[_Entry]] = {}
        self._searched: OrderedDict[tuple[str, ...], tuple[float, tuple[str, ...]]] = OrderedDict()
        self._lock = Lock()

    def grid(self, sha256: str) -> FieldGrid:
        """The grid under a hash. Raises NotFound, CorruptArtefact."""
        entry = self._held(_grid_key(sha256), lambda: grid_from_bytes(self._blobs.get(sha256)))
        assert isinstance(entry, FieldGrid)
        return entry

    def searchable(self, maps: Sequence[tuple[str, str]]) -> list[SearchableFloor]:
        """The floors of maps (floor id, hash of the grid) that are searched together, under the noise they share.

        Raises NotFound, CorruptArtefact.
        """
        floor_ids, hashes = tuple(floor_id for floor_id, _ in maps), tuple(sha256 for _, sha256 in maps)
        self._note(floor_ids, hashes, monotonic())
        return self._prepared(floor_ids, hashes)

    def searched_floors(self) -> set[str]:
        """The floors that were searched in the last minutes."""
        return {floor_id for floor_ids, _ in self._in_use() for floor_id in floor_ids}

    def renew(self, active: Mapping[str, str]) -> int:
        """Prepare maps (hash of the grid by floor) for the floors among them that are searched; the old ones stay until
        nobody asks for them. How many sets of floors had a new one. Raises NotFound, CorruptArtefact."""
        renewed = 0
        for floor_ids, hashes in self._in_use():
            new = tuple(active.get(floor_id, sha256) for floor_id, sha256 in zip(floor_ids, hashes, strict=True))
            if new != hashes:
                self._prepared(floor_ids, new)
                with self._lock:
                    used_at, _ = self._searched.get(floor_ids, (monotonic(), ()))
                    self._searched[floor_ids] = used_at, new
                renewed += 1
        return renewed

    def _in_use(self) -> list[tuple[tuple[str, ...], tuple[str, ...]]]:
        """Floors searched together, and their maps."""
        since = monotonic() - IN_USE_S
        with self._lock:
            return [(floor_ids, hashes) for floor_ids, (at, hashes) in self._searched.items() if at >= since]

    def _note(self, floor_ids: tuple[str, ...], hashes: tuple[str, ...], now: float) -> None:
        with self._lock:
            self._searched[floor_ids] = now, hashes
            self._searched.move_to_end(floor_ids)
            if len(self._searched) > MOST_IN_USE:
                self._searched.popitem(last=False)

    def _prepared(self, floor_ids: Sequence[str], hashes: Sequence[str]) -> list[SearchableFloor]:
        grids = [self.grid(sha256) for sha256 in hashes]
        noise_sd_uT = shared_noise_sd_uT(grids)
        return [
            self._floor(floor_id, sha256, grid, noise_sd_uT)
            for floor_id, sha256, grid in zip(floor_ids, hashes, grids, strict=True)
        ]

    def _floor(self, floor_id: str, sha256: str, grid: FieldGrid, noise_sd_uT: Array | None) -> SearchableFloor:
        key = (floor_id, sha256, b"" if noise_sd_uT is None else noise_sd_uT.tobytes())
        entry = self._held(key, lambda: prepare_floor(floor_id, grid, noise_sd_uT))
        assert isinstance(entry, SearchableFloor)
        return entry

    def _held(self, key: _Key, load: Callable[[], _Entry]) -> _Entry:
        """The entry under a key; several callers at once load it once, and share the error if that fails."""
        with self._lock:
            if key in self._entries:
                MAP_CACHE_LOOKUPS.labels("hit").inc()
                self._touch(key)
                return self._entries[key]
            mine = key not in self._loading
            loading = self._loading.setdefault(key, Future())
        MAP_CACHE_LOOKUPS.labels("miss").inc()
        if not mine:
            return loading.result()
        try:
            with MAP_CACHE_LOAD_SECONDS.time():
                entry = load()
        except BaseException as error:
            with self._lock:
                del self._loading[key]
            loading.set_exception(error)
            raise
        with self._lock:
            self._keep(key, entry)
            del self._loading[key]
        loading.set_result(entry)
        return entry

    def _keep(self, key: _Key, entry: _Entry) -> None:
        """Hold an entry (and the grid it stands on), then drop what was used longest ago until all fits."""
        self._entries[key] = entry
        if isinstance(entry, SearchableFloor):
            self._entries.setdefault(_grid_key(key[1]), entry.grid)
        self._touch(key)
        just_used = {key, _grid_key(key[1])}
        while self._bytes() > self._capacity_bytes and len(self._entries) > len(just_used):
            self._entries.popitem(last=False)
            MAP_CACHE_EVICTIONS.inc()
        MAP_CACHE_BYTES.set(self._bytes())

    def _touch(self, key: _Key) -> None:
        """A floor's grid counts as used after the floor, so that it is never dropped while a floor stands on it."""
        self._entries.move_to_end(key)
        self._entries.move_to_end(_grid_key(key[1]))

    def _bytes(self) -> int:
        grids: dict[int, int] = {}
        planes = 0
        for entry in self._entries.values():
            grid = entry if isinstance(entry, FieldGrid) else entry.grid
            grids[id(grid)] = grid.nbytes
            planes += 0 if isinstance(entry, FieldGrid) else sum(plane.nbytes for plane in entry.planes)
        return sum(grids.values()) + planes

    @property
    def nbytes(self) -> int:
        """Bytes of all that is held."""
        with self._lock:
            return self._bytes()

    def __len__(self) -> int:
        """How many maps are held, whatever was prepared from them."""
        with self._lock:
            return sum(isinstance(entry, FieldGrid) for entry in self._entries.values())


def _grid_key(sha256: str) -> _Key:
    return "", sha256, b""
