"""Maps held ready to answer: an LRU of searchable floors, bounded by bytes, keyed by content hash."""

from collections import OrderedDict
from threading import Lock

from app.blobs import BlobStore
from app.field.grid import FieldGrid
from app.positioning.locate import SearchableFloor, prepare_floor
from app.services.artefacts import grid_from_bytes

__all__ = ["GridCache"]


class GridCache:
    """A grid never changes under its hash, so an entry never goes stale; the oldest used is dropped when full."""

    def __init__(self, blobs: BlobStore, capacity_bytes: int) -> None:
        self._blobs = blobs
        self._capacity_bytes = capacity_bytes
        self._entries: OrderedDict[tuple[str, str], SearchableFloor] = OrderedDict()
        self._loading: dict[tuple[str, str], Lock] = {}
        self._lock = Lock()

    def grid(self, floor_id: str, sha256: str) -> FieldGrid:
        """The grid under a hash. Raises NotFound, CorruptArtefact."""
        return self.searchable(floor_id, sha256).grid

    def searchable(self, floor_id: str, sha256: str) -> SearchableFloor:
        """The grid under a hash with its search pyramids; several callers at once load it once."""
        key = (floor_id, sha256)
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key]
            loading = self._loading.setdefault(key, Lock())
        with loading:
            with self._lock:
                if key in self._entries:
                    return self._entries[key]
            floor = prepare_floor(floor_id, grid_from_bytes(self._blobs.get(sha256)))
            with self._lock:
                self._entries[key] = floor
                self._loading.pop(key, None)
                while len(self._entries) > 1 and self.nbytes > self._capacity_bytes:
                    self._entries.popitem(last=False)
        return floor

    @property
    def nbytes(self) -> int:
        return sum(floor.nbytes for floor in self._entries.values())

    def __len__(self) -> int:
        return len(self._entries)
