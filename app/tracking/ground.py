"""The ground: barriers nobody walks through, and places where one gets from a floor to another."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["Barriers", "Connector", "Ground", "barriers_of"]

_BUCKET_M = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Connector:
    """Stairs or a lift: floors, and where it is on all of them: `inside` (n, 2) points -> (n,) which are in it."""

    kind: Literal["stairs", "lift"]
    floor_ids: tuple[str, ...]
    inside: Callable[[Array], NDArray[np.bool_]]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """walls, by floor id: (k, 2, 2) ends of segments that no path crosses: walls, and the edges of the walkable area.
    walkable, by floor id: (n, 2) points -> (n,) where the device may be when it is first found."""

    walls: Mapping[str, Array] = field(default_factory=dict)
    walkable: Mapping[str, Callable[[Array], NDArray[np.bool_]]] = field(default_factory=dict)
    connectors: tuple[Connector, ...] = ()


class Barriers(NamedTuple):
    """Segments (k, 4) x0 y0 x1 y1 of all floors, in buckets of a square grid, for the compiled loops.

    frame    (f, 5) of each floor: x and y of its first bucket, rows, columns, index of its first bucket; no rows: none
    first    (buckets + 1,) where a bucket's segments begin in `members`
    members  (m,) indices of segments; one that touches several buckets is in each
    """

    segments: Array
    frame: Array
    first: NDArray[np.int64]
    members: NDArray[np.int64]


def barriers_of(walls: Mapping[str, Array], floor_ids: Sequence[str]) -> Barriers:
    """The walls of floors, in the order of the floors."""
    segments: list[Array] = []
    frame = np.zeros((len(floor_ids), 5))
    buckets: list[list[int]] = []
    for k, floor_id in enumerate(floor_ids):
        mine = np.asarray(walls.get(floor_id, np.zeros((0, 2, 2))), dtype=np.float64).reshape(-1, 4)
        frame[k, 4] = len(buckets)
        if not len(mine):
            continue
        ends = mine.reshape(-1, 2)
        low = np.floor(ends.min(axis=0) / _BUCKET_M) * _BUCKET_M
        columns, rows = (np.floor((ends.max(axis=0) - low) / _BUCKET_M).astype(int) + 1).tolist()
        frame[k, :4] = low[0], low[1], rows, columns
        mesh: list[list[int]] = [[] for _ in range(rows * columns)]
        for index, (x0, y0, x1, y1) in enumerate(mine, start=sum(map(len, segments))):
            for bucket in _touched(np.array([x0, y0]) - low, np.array([x1, y1]) - low, columns, rows):
                mesh[bucket].append(index)
        segments.append(mine)
        buckets += mesh
    counts = np.array([len(bucket) for bucket in buckets], dtype=np.int64)
    return Barriers(
        np.concatenate(segments) if segments else np.zeros((0, 4)),
        frame,
        np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        np.array([index for bucket in buckets for index in bucket], dtype=np.int64),
    )


def _touched(a: Array, b: Array, columns: int, rows: int) -> set[int]:
    """Buckets a segment passes through: looked at every tenth of a bucket, with the neighbours it may graze."""
    steps = int(np.linalg.norm(b - a) / (0.1 * _BUCKET_M)) + 2
    points = a + np.linspace(0.0, 1.0, steps)[:, None] * (b - a)
    near = (points[:, None] + 0.06 * _BUCKET_M * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])).reshape(-1, 2)
    cells = np.floor(near / _BUCKET_M).astype(int)
    kept = (cells >= 0).all(axis=1) & (cells[:, 0] < columns) & (cells[:, 1] < rows)
    return set((cells[kept, 1] * columns + cells[kept, 0]).tolist())
