"""Exact global search: branch and bound over the poses of all candidate floors, with one shared incumbent.

Returns the pose an exhaustive scan would return, and every pose within a window of it (see `kernels` for the bound).
A beam of promising blocks finds a good incumbent first; then every level of blocks is bounded, pruned and split, all
courses at once. What was pruned is bounded too: `missed_mass` says how much posterior it could hold at most. The work
is limited by a budget, counted and not timed, and by the caller's patience: where either ends first, fewer blocks are
followed, the others but bounded.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.geometry import Array
from app.positioning.floors import TOP_LEVEL, Plane
from app.positioning.kernels import block_bounds, pose_costs
from app.positioning.lattice import Courses, ReducedWindow, turn_window
from app.positioning.window_error import WindowError

__all__ = ["CAPACITY", "Candidates", "PosePrior", "search"]

Blocks = NDArray[np.int32]
CAPACITY = 400_000  # poses kept at most
LEAST_PRIOR_SD_M = 1e-3
BUDGET = 4_000_000_000  # values compared per plane at most: poses or blocks, times samples, times components
_OFFSET_BOUND_WORK = 2  # a bound over all offsets costs as much as so many plain ones
_TOP_SHARE = 0.25  # of the budget, for the blocks the search starts from
_BLOCKS_PER_POSE = 2  # how many blocks of a level may be followed, per pose of the capacity
_BEAM = 48
_OFFSET_TOP_LEVEL = 4  # larger blocks than this an offset nearly always explains
_DIVE_AGAIN = 1500  # blocks of one level: so many mean the incumbent is poor
_NEGLIGIBLE_NATS = 60.0
_SPARE_NATS = 12.0  # how far beyond the limit a bound is followed, so that the missed mass comes out small
_CHUNK = 20_000  # blocks bounded between two looks at the caller's patience


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Gaussian prior of the last sample's position, metres; no position: flat.

    walkable: per plane (ny, nx), the cells the last sample may be in, or None for all

    Raises InvalidInput for an sd below a millimetre.
    """

    position_m: tuple[float, float, float] | None = None
    sd_m: float = 1.0
    walkable: Sequence[NDArray[np.bool_]] | None = None

    def __post_init__(self) -> None:
        if not self.sd_m >= LEAST_PRIOR_SD_M:
            raise InvalidInput(
                f"the prior's sd_m is {self.sd_m:g}: no position is known that well; give at least "
                f"{LEAST_PRIOR_SD_M:g} m",
                Fault("/prior/sd_m", f"must be at least {LEAST_PRIOR_SD_M:g}"),
            )


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Poses by descending score.

    plane, course, row, column    (n,) indices
    score                         (n,) log L + log prior, nats, with the inflated variances that are searched by
    window_nats                   every pose within this of the best is here; `complete`: as many as asked, not fewer
                                  because too many qualify
    missed_mass                   at most this much, relative to the best pose's posterior, was left out
    poses                         how many poses the lattice has
    """

    plane: NDArray[np.int64]
    course: NDArray[np.int64]
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    score: Array
    window_nats: float
    complete: bool
    missed_mass: float
    poses: int

    def take(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> "Candidates":
        """Some of the poses, by index or mask."""
        parts = (self.plane, self.course, self.row, self.column, self.score)
        plane, course, row, column, score = (part[chosen] for part in parts)
        return replace(self, plane=plane, course=course, row=row, column=column, score=score)


class _PlaneCosts:
    """Costs and bounds on one plane; `constant` turns a cost into -2 score, comparable between planes."""

    def __init__(
        self,
        plane: Plane,
        window: ReducedWindow,
        courses: Courses,
        prior: PosePrior,
        error: WindowError,
        walkable: NDArray[np.bool_] | None,
    ) -> None:
        turned = turn_window(window, courses, plane.resolution_m)
        order = telling_order(window, plane)
        self.plane, self.courses = plane, len(courses)
        self.table = None if walkable is None else _summed(walkable)
        precision = error.offset_precision
        self.has_offset = precision is not None
        self.top = _OFFSET_TOP_LEVEL if self.has_offset else TOP_LEVEL
        self.compared: int = window.features_uT.size  # values per pose
        while self.top < TOP_LEVEL and self.work(self.top, len(self.top_blocks())) > _TOP_SHARE * BUDGET:
            self.top += 1
        self.z = np.ascontiguousarray(turned.features_uT[:, order])
        self.row = np.ascontiguousarray(turned.offset_cells[:, order, 0])
        self.column = np.ascontiguousarray(turned.offset_cells[:, order, 1])
        self.turn = np.ascontiguousarray(turned.turn[:, order])
        self.tilt = np.ascontiguousarray(window.tilt[order]) if len(window.tilt) else window.tilt
        self.inflation = error.inflation * error.own_share
        self.noise = window.noise_variance_uT2[order] / error.own_share
        noises, self.kind = np.unique(self.noise, return_inverse=True)
        ladder = plane.pyramid.ladder_uT2[None] + noises[:, None]
        n, c = window.features_uT.shape
        self.ladder = np.stack([self.inflation * ladder, c * np.log(ladder / ladder[:, :1])], axis=-1)
        self.least = float(plane.pyramid.ladder_uT2[0])
        self.course_cost = -2.0 * courses.log_prior
        self.prior, height = _prior_in_cells(plane, prior)
        floor = self.inflation * (self.least + self.noise)
        self.constant = c * float(np.log(2 * np.pi * floor).sum()) + height
        worth = n * c / error.inflation
        self.expected = self.constant + worth + 5.0 * (2.0 * worth) ** 0.5  # cost of a pose that matches
        weight = float(np.sum(1.0 / floor)) + (precision or 0.0)
        lightest = float(np.sum(1.0 / self.ladder[self.kind, -1, 0])) + (precision or 0.0)
        self.offset = (float(self.has_offset), precision or 0.0, weight, c * float(np.log(lightest / weight)))
        if precision is not None:  # one Gaussian factor per component is integrated out
            self.constant += c * float(np.log(weight / (precision or 2.0 * np.pi)))

    def costs(self, poses: Blocks, stop: float) -> Array:
        p = self.plane
        costs: Array = pose_costs(
            poses, self.offset, self.z, self.row, self.column, self.turn, self.tilt, self.noise, self.least,
            self.inflation, p.mean_uT, p.variance_uT2, self.course_cost, self.prior, stop - self.constant,
        )  # fmt: skip
        return costs + self.constant

    def bounds(self, blocks: Blocks, level: int, stop: float) -> Array:
        squares = self.plane.pyramid.levels[level - 1]
        height, width, size = squares.records.shape
        records = squares.records.reshape(-1, size)
        place = (squares.base, squares.step.bit_length() - 1, height, width)
        bounds: Array = block_bounds(
            blocks, squares.side, self.offset, self.z, self.row, self.column, self.turn, self.tilt, self.kind,
            self.ladder, place, records, records.view(np.uint8), self.course_cost, self.prior, stop - self.constant,
        )  # fmt: skip
        return bounds + self.constant

    def work(self, level: int, count: int) -> int:
        """What so many poses (level 0) or blocks cost of the budget, at most."""
        return count * self.compared * (_OFFSET_BOUND_WORK if self.has_offset and level else 1)

    def top_blocks(self) -> Blocks:
        ny, nx = self.plane.shape
        side = 1 << self.top
        h, j, i = np.meshgrid(np.arange(self.courses), np.arange(0, ny, side), np.arange(0, nx, side), indexing="ij")
        blocks = np.stack([h.ravel(), j.ravel(), i.ravel()], axis=1).astype(np.int32)
        return blocks if self.table is None else blocks[self.walkable_blocks(blocks, self.top)]

    def walkable_blocks(self, blocks: Blocks, level: int) -> NDArray[np.bool_]:
        """Which blocks hold a cell the last sample may be in."""
        assert self.table is not None
        (ny, nx), side = self.plane.shape, 1 << level
        j, i = np.minimum(blocks[:, 1], ny), np.minimum(blocks[:, 2], nx)
        below, right = np.minimum(j + side, ny), np.minimum(i + side, nx)
        held = self.table[below, right] - self.table[j, right] - self.table[below, i] + self.table[j, i]
        return np.asarray(held > 0)

    def split(self, blocks: Blocks, level: int, bounds: Array) -> tuple[Blocks, Array]:
        """The blocks of half the side that have walkable cells on the grid, each with its parent's bound."""
        ny, nx = self.plane.shape
        half = 1 << (level - 1)
        corners = np.array([[0, 0, 0], [0, 0, half], [0, half, 0], [0, half, half]], dtype=np.int32)
        children = (blocks[:, None, :] + corners).reshape(-1, 3)
        inside = (children[:, 1] < ny) & (children[:, 2] < nx)
        if self.table is not None:
            inside &= self.walkable_blocks(children, level - 1)
        return children[inside], np.repeat(bounds, 4)[inside]

    def cells(self, blocks: Blocks, level: int) -> Array:
        ny, nx = self.plane.shape
        side = 1 << level
        return np.minimum(side, ny - blocks[:, 1]) * np.minimum(side, nx - blocks[:, 2]).astype(np.float64)


def search(
    planes: Sequence[Plane],
    window: ReducedWindow,
    courses: Courses,
    prior: PosePrior,
    error: WindowError,
    *,
    window_nats: float,
    capacity: int = CAPACITY,
    budget: int = BUDGET,
    out_of_time: Callable[[], bool] | None = None,
) -> Candidates:
    """Every pose of the planes within `window_nats` of the best.

    At most `capacity` poses are kept, `budget` values compared on each plane, and no more looked at once `out_of_time`
    says so; what that leaves out is counted in `missed_mass`, and `complete` says so.
    """
    walkable = prior.walkable or [None] * len(planes)
    costs = [
        _PlaneCosts(plane, window, courses, prior, error, mask) for plane, mask in zip(planes, walkable, strict=True)
    ]
    expected = max(on_plane.expected for on_plane in costs) + 2.0 * (window_nats + _SPARE_NATS)
    patience = _Patience(out_of_time)
    starts = [_start(on_plane, expected, patience) for on_plane in costs]
    seeds = [start.seed_cost for start in starts]
    sweep = _Sweep(min(seeds), 2.0 * window_nats, capacity // len(planes), budget, patience)
    found: list[tuple[Blocks, Array]] = [(np.empty((0, 3), np.int32), np.empty(0))] * len(planes)
    for k in np.argsort(seeds, kind="stable"):  # the best incumbent first
        found[k] = sweep.run(costs[k], starts[k])
    plane = np.concatenate([np.full(len(poses), k) for k, (poses, _) in enumerate(found)])
    poses = np.concatenate([poses for poses, _ in found]).astype(np.int64)
    cost = np.concatenate([cost for _, cost in found])
    inside = cost <= sweep.best + sweep.window
    order = np.flatnonzero(inside)
    order = order[np.lexsort((poses[order, 2], poses[order, 1], poses[order, 0], plane[order], cost[order]))]
    sweep.miss_poses(cost[~inside])
    return Candidates(
        plane=plane[order],
        course=poses[order, 0],
        row=poses[order, 1],
        column=poses[order, 2],
        score=-0.5 * cost[order],
        window_nats=0.5 * sweep.window,
        complete=sweep.window == 2.0 * window_nats and not patience.ended,
        missed_mass=sweep.missed_mass,
        poses=len(courses) * sum(p.shape[0] * p.shape[1] for p in planes),
    )


class _Patience:
    """Whether the caller still waits; once it does not, it never does again."""

    def __init__(self, out_of_time: Callable[[], bool] | None) -> None:
        self._out_of_time = out_of_time
        self.ended = False

    def over(self) -> bool:
        self.ended = self.ended or (self._out_of_time is not None and self._out_of_time())
        return self.ended

    def bounds(self, on_plane: _PlaneCosts, blocks: Blocks, level: int, stop: float, known: Array) -> Array:
        """Bounds of blocks, those that are reached in time; of the others what is `known` (their parents')."""
        found = known
        for start in range(0, len(blocks), _CHUNK):
            if self.over():
                break
            part = slice(start, start + _CHUNK)
            found[part] = on_plane.bounds(blocks[part], level, stop)
        return found


class _Sweep:
    """Level by level over one plane after the other; the incumbent and the window carry over."""

    def __init__(self, best: float, window: float, capacity: int, budget: int, patience: _Patience) -> None:
        self.best, self.window, self.capacity = best, window, max(capacity, 1)
        self.budget, self.patience = budget, patience
        self.missed_mass = 0.0  # at most, relative to the best pose

    def run(self, on_plane: _PlaneCosts, start: "_Start") -> tuple[Blocks, Array]:
        """The poses of a plane that are within the window of the best so far, with their costs; the seed among them."""
        blocks, bounds, seed, seed_cost = start.blocks, start.bounds, start.seed, start.seed_cost
        if not len(blocks):
            return blocks, bounds
        if self._stop() > start.followed_to:
            again = bounds <= self._stop()
            bounds[again] = self.patience.bounds(on_plane, blocks[again], on_plane.top, self._stop(), bounds[again])
        left = self.budget - on_plane.work(on_plane.top, len(blocks))
        for level in range(on_plane.top, 0, -1):
            if level < on_plane.top:
                bounds = self.patience.bounds(on_plane, blocks, level, self._stop(), bounds)
            if level < on_plane.top and len(blocks) > _DIVE_AGAIN:
                pose, cost = _dive(on_plane, blocks, bounds, level)
                seed, seed_cost = (pose, cost) if cost < seed_cost else (seed, seed_cost)
                self._improve(cost)
            if self.patience.over():
                left = 0
            affordable = left // (level * on_plane.work(level - 1, 4))  # an even share for every level still to come
            keep = self._keep(bounds, max(min(_BLOCKS_PER_POSE * self.capacity, affordable), 1))
            self.miss(on_plane, blocks, bounds, ~keep, level)
            blocks, bounds = on_plane.split(blocks[keep], level, bounds[keep])
            left -= on_plane.work(level - 1, len(blocks))
        seeded = np.flatnonzero((blocks == seed).all(axis=1))
        blocks = np.concatenate([seed, np.delete(blocks, seeded, axis=0)])
        costs = on_plane.costs(blocks, self._stop())
        costs[0] = seed_cost
        self._improve(float(costs.min()))
        keep = self._keep(costs, self.capacity)
        keep[np.argmin(costs)] = True
        self.miss(on_plane, blocks, costs, ~keep, 0)
        return blocks[keep], costs[keep]

    def miss(
        self, on_plane: _PlaneCosts, blocks: Blocks, bounds: Array, left_out: NDArray[np.bool_], level: int
    ) -> None:
        """Count blocks that are left out, by their bounds."""
        near = np.flatnonzero(left_out & (bounds < self.best + 2.0 * _NEGLIGIBLE_NATS))
        self.missed_mass += float(np.sum(on_plane.cells(blocks[near], level) * self._mass(bounds[near])))

    def miss_poses(self, costs: Array) -> None:
        """Count poses that are left out in the end."""
        self.missed_mass += float(np.sum(self._mass(costs)))

    def _improve(self, cost: float) -> None:
        if cost < self.best:
            self.missed_mass *= float(np.exp(0.5 * (cost - self.best)))
            self.best = cost

    def _mass(self, costs: Array) -> Array:
        """Posterior mass relative to the best pose so far."""
        return np.asarray(np.exp(np.minimum(0.5 * (self.best - costs), 300.0)))

    def _stop(self) -> float:
        return self.best + self.window + 2.0 * _SPARE_NATS

    def _keep(self, bounds: Array, room: int) -> NDArray[np.bool_]:
        """Which to follow: those within the window, which shrinks when they are more than there is room for."""
        keep = bounds <= self.best + self.window
        if keep.sum() <= room:
            return keep
        self.window = max(float(np.partition(bounds, room)[room]) - self.best, 0.0)
        chosen = np.flatnonzero(bounds <= self.best + self.window)
        if len(chosen) > room:  # as good as equal: some of them, evenly
            chosen = chosen[np.linspace(0, len(chosen) - 1, room).astype(np.int64)]
        keep[:] = False
        keep[chosen] = True
        return keep


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """The top blocks with their bounds, followed up to `followed_to`, and a good pose (1, 3) as first incumbent."""

    blocks: Blocks
    bounds: Array
    followed_to: float
    seed: Blocks
    seed_cost: float


def _start(on_plane: _PlaneCosts, expected: float, patience: _Patience) -> _Start:
    """Bound the top blocks as far as a matching window needs it, and follow the most promising down to a pose."""
    top = on_plane.top_blocks()
    if not len(top):  # nowhere to walk on this plane
        return _Start(top, np.empty(0), expected, top, np.inf)
    known = np.full(len(top), on_plane.constant + float(on_plane.course_cost.min()))
    bounds = patience.bounds(on_plane, top, on_plane.top, expected, known)
    seed, seed_cost = _dive(on_plane, top, bounds, on_plane.top)
    return _Start(top, bounds, expected, seed, seed_cost)


def _dive(on_plane: _PlaneCosts, blocks: Blocks, bounds: Array, level: int) -> tuple[Blocks, float]:
    """Follow the most promising blocks of a level down to a pose (1, 3) and its cost."""
    while level > 0:
        if len(blocks) > _BEAM:
            chosen = np.argpartition(bounds, _BEAM)[:_BEAM]
            blocks, bounds = blocks[chosen], bounds[chosen]
        blocks, bounds = on_plane.split(blocks, level, bounds)
        level -= 1
        bounds = on_plane.bounds(blocks, level, np.inf) if level else on_plane.costs(blocks, np.inf)
    best = int(np.argmin(bounds))
    return blocks[best : best + 1], float(bounds[best])


def _summed(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(ny + 1, nx + 1) summed-area table."""
    table = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), dtype=np.int64)
    table[1:, 1:] = mask.cumsum(axis=0).cumsum(axis=1)
    return table


def _prior_in_cells(plane: Plane, prior: PosePrior) -> tuple[Array, float]:
    """(row, column, cost per squared cell) of the position prior on a plane and the cost of the plane's height."""
    if prior.position_m is None:
        return np.zeros(3), 0.0
    x, y, z = prior.position_m
    weight = 1.0 / prior.sd_m**2
    row, column = (y - plane.origin_m[1]) / plane.resolution_m, (x - plane.origin_m[0]) / plane.resolution_m
    height = weight * (z - plane.height_m) ** 2
    return np.array([row, column, weight * plane.resolution_m**2]), float(height)


def telling_order(window: ReducedWindow, plane: Plane) -> NDArray[np.int64]:
    """The samples, the most telling first: unlike the ambient field, and far from those already taken."""
    strength, usual = window.features_uT, plane.ambient_uT
    if window.turns:
        strength = np.column_stack([np.hypot(strength[:, 0], strength[:, 1]), strength[:, 2]])
        usual = np.array([np.hypot(usual[0], usual[1]), usual[2]])
    unusual = np.linalg.norm(strength - usual, axis=1)
    unusual /= max(float(unusual.max()), 1e-9)
    order = [int(np.argmax(unusual))]
    distance = np.full(len(window), np.inf)
    for _ in range(len(window) - 1):
        latest = window.from_last_m[order[-1]]
        distance = np.minimum(distance, np.linalg.norm(window.from_last_m - latest, axis=1))
        merit = np.minimum(distance, 4.0) / 4.0 + 0.5 * unusual
        merit[order] = -1.0
        order.append(int(np.argmax(merit)))
    return np.array(order)
