"""The cache of maps: what it holds, what it drops, and that nothing is loaded or prepared twice."""

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import numpy as np
import pytest

from app.blobs import FolderBlobStore
from app.errors import NotFound
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components
from app.positioning.locate import SearchableFloor, prepare_floor
from app.services.artefacts import grid_to_bytes
from app.services.grid_cache import GridCache

PLENTY = 2**30


class CountingStore(FolderBlobStore):
    """A folder of blobs that notes what was read."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.read: Counter[str] = Counter()

    def get(self, sha256: str) -> bytes:
        self.read[sha256] += 1
        return super().get(sha256)


@pytest.fixture
def blobs(tmp_path: Path) -> CountingStore:
    return CountingStore(tmp_path)


def make_grid(seed: int, noise_sd_uT: float = 0.5, components: Components = "vector") -> FieldGrid:
    rng = np.random.default_rng(seed)
    c = len(COMPONENT_NAMES[components])
    shape = (1, 20, 20, c)
    return FieldGrid(
        components=components,
        origin_m=(0.0, 0.0),
        resolution_m=0.5,
        heights_m=np.array([1.2]),
        mean_uT=rng.normal(size=shape).astype(np.float32),
        sd_uT=np.ones(shape, dtype=np.float32),
        gradient_uT_per_m=rng.normal(size=(*shape, 2)).astype(np.float32),
        measured=np.ones(shape[:3], dtype=bool),
        ambient_uT=np.zeros(c),
        prior_sd_uT=np.full(c, 5.0),
        noise_sd_uT=np.full(c, noise_sd_uT),
    )


def stored(blobs: CountingStore, count: int) -> list[tuple[str, str]]:
    """(floor id, hash) of maps with noises of their own."""
    return [(f"f{k}", blobs.put(grid_to_bytes(make_grid(k, 0.5 + k)))) for k in range(count)]


def bytes_of(floors: Sequence[SearchableFloor]) -> int:
    return sum(floor.nbytes for floor in floors)


def test_a_warm_cache_loads_and_prepares_nothing(blobs: CountingStore) -> None:
    cache, maps = GridCache(blobs, PLENTY), stored(blobs, 3)
    first = cache.searchable(maps)
    again = cache.searchable(maps)
    assert all(a is b for a, b in zip(first, again, strict=True))
    assert set(blobs.read.values()) == {1}
    assert cache.nbytes == bytes_of(first)
    assert len(cache) == 3
    assert cache.searchable([]) == []


def test_the_floor_used_longest_ago_is_dropped(blobs: CountingStore) -> None:
    maps = stored(blobs, 3)
    one = prepare_floor("f0", make_grid(0)).nbytes
    cache = GridCache(blobs, int(2.5 * one))
    floors = []
    for each in (maps[0], maps[1], maps[0], maps[2]):  # maps[1] is the oldest when there is no room for a third
        floors += cache.searchable([each])
        assert cache.nbytes <= 2.5 * one
    assert cache.searchable([maps[0]])[0] is floors[0]
    assert cache.searchable([maps[2]])[0] is floors[3]
    assert cache.searchable([maps[1]])[0] is not floors[1]


def test_what_was_just_loaded_stays_however_large(blobs: CountingStore) -> None:
    cache, maps = GridCache(blobs, 1), stored(blobs, 2)
    assert len(cache.searchable(maps)) == 2
    (last,) = cache.searchable(maps[1:])
    assert cache.searchable(maps[1:])[0] is last
    assert cache.nbytes == last.nbytes
    assert len(cache) == 1


def test_a_grid_is_held_once_for_all_that_stands_on_it(blobs: CountingStore) -> None:
    cache, maps = GridCache(blobs, PLENTY), stored(blobs, 2)
    (alone,) = cache.searchable(maps[:1])
    together = cache.searchable(maps)
    assert alone.grid is together[0].grid is cache.grid(maps[0][1])
    np.testing.assert_array_equal(alone.noise_sd_uT, 0.5)
    np.testing.assert_array_equal(together[0].noise_sd_uT, 1.5)
    assert cache.nbytes == bytes_of([alone, *together]) - alone.grid.nbytes
    assert set(blobs.read.values()) == {1}


def test_a_grid_asked_for_as_a_field_needs_no_pyramids(blobs: CountingStore) -> None:
    cache, (_, sha256) = GridCache(blobs, PLENTY), stored(blobs, 1)[0]
    assert cache.nbytes == 0 < cache.grid(sha256).nbytes
    assert cache.nbytes == cache.grid(sha256).nbytes


def test_a_new_map_of_one_floor_prepares_the_others_again_once(blobs: CountingStore) -> None:
    maps = stored(blobs, 3)
    cache = GridCache(blobs, 4 * prepare_floor("f0", make_grid(0)).nbytes)
    before = cache.searchable(maps)
    maps[2] = ("f2", blobs.put(grid_to_bytes(make_grid(9, 9.0))))
    after = cache.searchable(maps)
    assert after[0] is not before[0]
    assert after[0].grid is before[0].grid
    assert after[0].noise_sd_uT[0] > before[0].noise_sd_uT[0]
    assert all(a is b for a, b in zip(after, cache.searchable(maps), strict=True))
    assert set(blobs.read.values()) == {1}
    assert cache.nbytes <= 4 * before[0].nbytes, "what was prepared for the old map made room"


def test_unlike_maps_keep_their_own_noise(blobs: CountingStore) -> None:
    level = ("l", blobs.put(grid_to_bytes(make_grid(1, 2.0, "level"))))
    floors = GridCache(blobs, PLENTY).searchable([*stored(blobs, 1), level])
    assert [floor.noise_sd_uT[0] for floor in floors] == [0.5, 2.0]


def test_callers_at_once_load_and_prepare_once(blobs: CountingStore) -> None:
    cache, maps, start = GridCache(blobs, PLENTY), stored(blobs, 2), Barrier(8)

    def ask() -> list[SearchableFloor]:
        start.wait()
        return cache.searchable(maps)

    with ThreadPoolExecutor(8) as threads:
        answers = [future.result() for future in [threads.submit(ask) for _ in range(8)]]
    assert all(answer[k] is answers[0][k] for answer in answers for k in range(2))
    assert set(blobs.read.values()) == {1}


def test_threads_under_pressure_stay_within_the_capacity(blobs: CountingStore) -> None:
    maps = stored(blobs, 5)
    one = prepare_floor("f0", make_grid(0)).nbytes
    cache = GridCache(blobs, 2 * one + one // 2)

    def ask(seed: int) -> None:
        for k in np.random.default_rng(seed).integers(5, size=30):
            (floor,) = cache.searchable([maps[k]])
            assert floor.floor_id == f"f{k}"
            assert cache.nbytes <= 2.5 * one

    with ThreadPoolExecutor(4) as threads:
        for future in [threads.submit(ask, seed) for seed in range(4)]:
            future.result()


def test_a_failed_load_is_told_and_may_be_tried_again(blobs: CountingStore, tmp_path: Path) -> None:
    cache, grid = GridCache(blobs, PLENTY), grid_to_bytes(make_grid(3))
    sha256 = CountingStore(tmp_path / "elsewhere").put(grid)
    for _ in range(2):
        with pytest.raises(NotFound):
            cache.searchable([("f", sha256)])
    blobs.put(grid)
    assert len(cache.searchable([("f", sha256)])) == 1
