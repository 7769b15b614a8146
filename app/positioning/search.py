"""Exact global search: branch and bound over the poses of all candidate floors, with one shared incumbent.

Returns the pose an exhaustive scan would return, and every pose within a window of it (see `kernels` for the bound).
A beam of promising blocks finds a good incumbent first; then every level of blocks is bounded, pruned and split, all
headings at once. What was pruned is bounded too: `missed_mass` says how much posterior it could hold at most. The work
is limited by a budget, counted and not timed: where it ends first, fewer blocks are followed, the others but bounded.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.geometry import Array
from app.positioning.floors import TOP_LEVEL, Plane
from app.positioning.kernels import block_bounds, pose_costs
from app.positioning.lattice import ReducedWindow, turn_window

__all__ = ["CAPACITY", "Candidates", "PosePrior", "search"]

Blocks = NDArray[np.int32]
CAPACITY = 400_000  # poses kept at most
LEAST_PRIOR_SD_M = 1e-3
BUDGET = 400_000_000  # values compared per plane at most: poses or blocks, times samples, times components
_DEMEANED_BOUND_WORK = 3  # a bound over all offsets costs as much as so many plain ones
_TOP_SHARE = 0.25  # of the budget, for the blocks the search starts from
_BLOCKS_PER_POSE = 2  # how many blocks of a level may be followed, per pose of the capacity
_BEAM = 48
_DEMEANED_TOP_LEVEL = 3  # larger blocks than this an offset nearly always explains
_DIVE_AGAIN = 1500  # blocks of one level: so many mean the incumbent is poor
_NEGLIGIBLE_NATS = 60.0
_SPARE_NATS = 12.0  # tempered: how far beyond the limit a bound is followed, so that the missed mass comes out small


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Gaussian prior of the last sample's position (metres) and of the heading lattice, as tempered log densities.

    position_m, sd_m   None: flat
    heading_log        (h,) log density of each heading up to a constant

    Raises InvalidInput for an sd below a millimetre.
    """

    position_m: tuple[float, float, float] | None
    sd_m: float
    heading_log: Array

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

    plane, heading, row, column   (n,) indices
    score                         (n,) log L + temper log prior, nats
    window_nats                   every pose within this of the best is here; `complete`: as many as asked, not fewer
                                  because too many qualify
    missed_mass                   at most this much, relative to the best pose's tempered posterior, was left out
    poses                         how many poses the lattice has
    """

    plane: NDArray[np.int64]
    heading: NDArray[np.int64]
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    score: Array
    window_nats: float
    complete: bool
    missed_mass: float
    poses: int


class _PlaneCosts:
    """Costs and bounds on one plane; `constant` turns a cost into -2 score, comparable between planes."""

    def __init__(
        self, plane: Plane, window: ReducedWindow, headings_rad: Array, prior: PosePrior, temper: float, demeaned: bool
    ) -> None:
        turned = turn_window(window, headings_rad, plane.resolution_m)
        order = telling_order(window, plane)
        self.plane, self.demeaned, self.headings = plane, demeaned, len(headings_rad)
        self.top = _DEMEANED_TOP_LEVEL if demeaned else TOP_LEVEL
        self.compared: int = window.features_uT.size  # values per pose
        while self.top < TOP_LEVEL and self.work(self.top, len(self.top_blocks())) > _TOP_SHARE * BUDGET:
            self.top += 1
        self.z = np.ascontiguousarray(turned.features_uT[:, order])
        self.row = np.ascontiguousarray(turned.offset_cells[:, order, 0])
        self.column = np.ascontiguousarray(turned.offset_cells[:, order, 1])
        self.noise = window.noise_variance_uT2[order]
        noises, self.kind = np.unique(self.noise, return_inverse=True)
        ladder = plane.pyramid.ladder_uT2[None] + noises[:, None, None]
        self.ladder = np.stack([ladder, np.log(ladder / ladder[:, :, :1])], axis=-1)
        self.least = np.ascontiguousarray(plane.pyramid.ladder_uT2[:, 0])
        self.heading_cost = -2.0 * temper * prior.heading_log
        self.prior, height = _prior_in_cells(plane, prior, temper)
        floor = self.least[None, :] + self.noise[:, None]
        n, c = floor.shape
        self.constant = float(np.log(floor).sum() + n * c * np.log(2 * np.pi)) + height
        self.expected = self.constant + n * c + 5.0 * (2.0 * n * c) ** 0.5  # cost of a pose that matches
        if demeaned:  # one Gaussian factor per component is integrated out
            self.constant -= float(np.log(2 * np.pi * ladder[0, :, 0]).sum())

    def costs(self, poses: Blocks, stop: float) -> Array:
        p = self.plane
        costs: Array = pose_costs(
            poses, self.demeaned, self.z, self.row, self.column, self.noise, self.least, p.mean_uT, p.variance_uT2,
            self.heading_cost, self.prior, stop - self.constant,
        )  # fmt: skip
        return costs + self.constant

    def bounds(self, blocks: Blocks, level: int, stop: float) -> Array:
        squares = self.plane.pyramid.levels[level - 1]
        height, width, size = squares.records.shape
        records = squares.records.reshape(-1, size)
        place = (squares.base, squares.step.bit_length() - 1, height, width)
        bounds: Array = block_bounds(
            blocks, squares.side, self.demeaned, self.z, self.row, self.column, self.kind, self.ladder, place,
            records, records.view(np.uint8), self.heading_cost, self.prior, stop - self.constant,
        )  # fmt: skip
        return bounds + self.constant

    def work(self, level: int, count: int) -> int:
        """What so many poses (level 0) or blocks cost of the budget, at most."""
        return count * self.compared * (_DEMEANED_BOUND_WORK if self.demeaned and level else 1)

    def top_blocks(self) -> Blocks:
        ny, nx = self.plane.shape
        side = 1 << self.top
        h, j, i = np.meshgrid(np.arange(self.headings), np.arange(0, ny, side), np.arange(0, nx, side), indexing="ij")
        return np.stack([h.ravel(), j.ravel(), i.ravel()], axis=1).astype(np.int32)

    def split(self, blocks: Blocks, level: int) -> Blocks:
        """The blocks of half the side that have cells on the grid."""
        ny, nx = self.plane.shape
        half = 1 << (level - 1)
        corners = np.array([[0, 0, 0], [0, 0, half], [0, half, 0], [0, half, half]], dtype=np.int32)
        children = (blocks[:, None, :] + corners).reshape(-1, 3)
        return children[(children[:, 1] < ny) & (children[:, 2] < nx)]

    def cells(self, blocks: Blocks, level: int) -> Array:
        ny, nx = self.plane.shape
        side = 1 << level
        return np.minimum(side, ny - blocks[:, 1]) * np.minimum(side, nx - blocks[:, 2]).astype(np.float64)


def search(
    planes: Sequence[Plane],
    window: ReducedWindow,
    headings_rad: Array,
    prior: PosePrior,
    *,
    window_nats: float,
    temper: float = 1.0,
    demeaned: bool = False,
    capacity: int = CAPACITY,
    budget: int = BUDGET,
) -> Candidates:
    """Every pose of the planes within `window_nats` of the best, tempered by `temper` for the missed mass only.

    At most `capacity` poses are kept, and `budget` values compared on each plane; what that leaves out is counted in
    `missed_mass`, and `complete` says so.
    """
    costs = [_PlaneCosts(plane, window, headings_rad, prior, temper, demeaned) for plane in planes]
    expected = max(on_plane.expected for on_plane in costs) + 2.0 * (window_nats + temper * _SPARE_NATS)
    starts = [_start(on_plane, expected) for on_plane in costs]
    sweep = _Sweep(min(start.seed_cost for start in starts), 2.0 * window_nats, temper, capacity // len(planes), budget)
    found = [sweep.run(on_plane, start) for on_plane, start in zip(costs, starts, strict=True)]
    plane = np.concatenate([np.full(len(poses), k) for k, (poses, _) in enumerate(found)])
    poses = np.concatenate([poses for poses, _ in found]).astype(np.int64)
    cost = np.concatenate([cost for _, cost in found])
    inside = cost <= sweep.best + sweep.window
    order = np.flatnonzero(inside)
    order = order[np.lexsort((poses[order, 2], poses[order, 1], poses[order, 0], plane[order], cost[order]))]
    sweep.miss_poses(cost[~inside])
    return Candidates(
        plane=plane[order],
        heading=poses[order, 0],
        row=poses[order, 1],
        column=poses[order, 2],
        score=-0.5 * cost[order],
        window_nats=0.5 * sweep.window,
        complete=sweep.window == 2.0 * window_nats,
        missed_mass=sweep.missed_mass,
        poses=len(headings_rad) * sum(p.shape[0] * p.shape[1] for p in planes),
    )


class _Sweep:
    """Level by level over one plane after the other; the incumbent and the window carry over."""

    def __init__(self, best: float, window: float, temper: float, capacity: int, budget: int) -> None:
        self.best, self.window, self.temper, self.capacity = best, window, temper, max(capacity, 1)
        self.budget = budget
        self.missed_mass = 0.0  # at most, relative to the best pose

    def run(self, on_plane: _PlaneCosts, start: "_Start") -> tuple[Blocks, Array]:
        """The poses of a plane that are within the window of the best so far, with their costs; the seed among them."""
        blocks, bounds, seed, seed_cost = start.blocks, start.bounds, start.seed, start.seed_cost
        if self._stop() > start.followed_to:
            again = bounds <= self._stop()
            bounds[again] = on_plane.bounds(blocks[again], on_plane.top, self._stop())
        left = self.budget - on_plane.work(on_plane.top, len(blocks))
        for level in range(on_plane.top, 0, -1):
            if level < on_plane.top:
                bounds = on_plane.bounds(blocks, level, self._stop())
            if level < on_plane.top and len(blocks) > _DIVE_AGAIN:
                pose, cost = _dive(on_plane, blocks, bounds, level)
                seed, seed_cost = (pose, cost) if cost < seed_cost else (seed, seed_cost)
                self._improve(cost)
            affordable = left // (level * on_plane.work(level - 1, 4))  # an even share for every level still to come
            keep = self._keep(bounds, max(min(_BLOCKS_PER_POSE * self.capacity, affordable), 1))
            self.miss(on_plane, blocks, bounds, ~keep, level)
            blocks = on_plane.split(blocks[keep], level)
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
        near = np.flatnonzero(left_out & (bounds < self.best + 2.0 * self.temper * _NEGLIGIBLE_NATS))
        self.missed_mass += float(np.sum(on_plane.cells(blocks[near], level) * self._mass(bounds[near])))

    def miss_poses(self, costs: Array) -> None:
        """Count poses that are left out in the end."""
        self.missed_mass += float(np.sum(self._mass(costs)))

    def _improve(self, cost: float) -> None:
        if cost < self.best:
            self.missed_mass *= float(np.exp((cost - self.best) / (2.0 * self.temper)))
            self.best = cost

    def _mass(self, costs: Array) -> Array:
        """Tempered posterior mass relative to the best pose so far."""
        return np.asarray(np.exp(np.minimum((self.best - costs) / (2.0 * self.temper), 300.0)))

    def _stop(self) -> float:
        return self.best + self.window + 2.0 * self.temper * _SPARE_NATS

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


def _start(on_plane: _PlaneCosts, expected: float) -> _Start:
    """Bound the top blocks as far as a matching window needs it, and follow the most promising down to a pose."""
    top = on_plane.top_blocks()
    top_bounds = on_plane.bounds(top, on_plane.top, expected)
    seed, seed_cost = _dive(on_plane, top, top_bounds, on_plane.top)
    return _Start(top, top_bounds, expected, seed, seed_cost)


def _dive(on_plane: _PlaneCosts, blocks: Blocks, bounds: Array, level: int) -> tuple[Blocks, float]:
    """Follow the most promising blocks of a level down to a pose (1, 3) and its cost."""
    while level > 0:
        if len(blocks) > _BEAM:
            blocks = blocks[np.argpartition(bounds, _BEAM)[:_BEAM]]
        blocks = on_plane.split(blocks, level)
        level -= 1
        bounds = on_plane.bounds(blocks, level, np.inf) if level else on_plane.costs(blocks, np.inf)
    best = int(np.argmin(bounds))
    return blocks[best : best + 1], float(bounds[best])


def _prior_in_cells(plane: Plane, prior: PosePrior, temper: float) -> tuple[Array, float]:
    """(row, column, cost per squared cell) of the position prior on a plane and the cost of the plane's height."""
    if prior.position_m is None:
        return np.zeros(3), 0.0
    x, y, z = prior.position_m
    weight = temper / prior.sd_m**2
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
