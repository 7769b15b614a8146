"""Exact global search: branch and bound over the poses of all candidate floors, with one shared incumbent.

Returns the pose an exhaustive scan would return, and every pose within a window of it. The tree is joint: a node
holds the poses of a group of courses whose middle sample is in a block of cells (see `course_tree` for the groups,
`kernels` and `offset_bound` for the bounds); both are halved from level to level. A beam of promising nodes finds a
good incumbent first; then every level is bounded, pruned and split. What was pruned is bounded too: `missed_mass`
says how much posterior it could hold at most. The work is limited by a budget, counted and not timed, and by the
caller's patience: where either ends first, fewer nodes are followed, the others but bounded.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.course_tree import CourseTree, course_tree
from app.positioning.descent import dive, split, top, top_nodes
from app.positioning.floors import Plane
from app.positioning.kernels import Scene
from app.positioning.lattice import Courses, ReducedWindow, turn_window
from app.positioning.pose_prior import PosePrior
from app.positioning.scene import make_scene, telling_order
from app.positioning.window_error import WindowError

__all__ = ["CAPACITY", "Candidates", "PosePrior", "search"]

Nodes = NDArray[np.int32]
CAPACITY = 400_000  # poses kept at most
BUDGET = 4_000_000_000  # values compared per plane at most: poses or nodes, times samples, times components
_TOP_SHARE = 0.25  # of the budget, for the nodes the search starts from
_MOST_NODES = 800_000  # of a level that may be followed on a plane
_TOP = 4  # the level to start from: what larger blocks hold is hardly ever excluded
_SHARE = 1.0  # of a block's side, by which a group of courses may spread the samples
_BEAM = 16
_WIDE = 300
_DIVE_AGAIN = 1500  # nodes of one level: so many mean the incumbent is poor
_NEGLIGIBLE_NATS = 60.0
_CHUNK = 4_000  # nodes split between two looks at the caller's patience


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
        plane, course, row, column = (each[chosen] for each in (self.plane, self.course, self.row, self.column))
        return replace(self, plane=plane, course=course, row=row, column=column, score=self.score[chosen])


class _OnPlane:
    """The tree over one plane."""

    def __init__(self, scene: Scene, tree: CourseTree, compared: int, top: int) -> None:
        self.scene, self.courses, self.compared, self.top = scene, tree, compared, top
        self.tree = tree.tree
        self.ny, self.nx = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2
        self.stage = tree.stages[top]
        middle, side = self.tree.middle[self.stage.first : self.stage.last], 1 << top
        row, column = (int(middle[:, k].min()) // side * side for k in (0, 2))
        height = (self.ny - 1 + int(middle[:, 1].max()) - row) // side + 1
        width = (self.nx - 1 + int(middle[:, 3].max()) - column) // side + 1
        self.area = row, column, height, width

    def start(self, first: int, last: int, best: float, window: float) -> tuple[Nodes, Array, int, float]:
        """Top nodes of some groups that may matter, their bounds, the values compared, and the mass the others hold."""
        nodes, bounds, used, missed = top(first, last, self.top, self.area, self.tree, self.scene, best, window)
        return nodes, bounds, int(used) * self.compared, float(missed)

    def split(
        self, nodes: Nodes, level: int, best: float, window: float, allowed: int
    ) -> tuple[Nodes, Array, int, int, float, float]:
        """The parts of nodes that may matter, their bounds, how many nodes were split with as many comparisons as
        allowed, the values compared, the mass other parts hold, and the least cost of a part."""
        parts, bounds, done, used, missed, least = split(
            nodes, level, self.tree, self.scene, best, window, allowed // self.compared
        )
        return parts, bounds, int(done), int(used) * self.compared, float(missed), float(least)

    def seed(self) -> tuple[Nodes, float]:
        """A good pose (1, 3) of the plane and its cost; none (0, 3) if it has none."""
        nodes, costs = top_nodes(self.stage.first, self.stage.last, self.top, self.area, self.tree, self.scene)
        return self.dive(nodes, costs, self.top, np.inf, wide=len(nodes))

    def dive(self, nodes: Nodes, bounds: Array, level: int, best: float, wide: int) -> tuple[Nodes, float]:
        """A good pose (1, 3) below some nodes, and its cost, exact if below `best`; none (0, 3) if none of them holds
        one."""
        beam = _BEAM
        while True:
            pose, cost = dive(nodes, bounds, level, max(wide, beam), beam, self.tree, self.scene, best)
            if len(pose) or beam >= len(nodes):
                return pose, float(cost)
            beam *= 8

    def most(self, nodes: Nodes) -> int:
        """Values compared at most to split nodes."""
        g = nodes[:, 0]
        parts = int(np.maximum(self.tree.first[g + 1] - self.tree.first[g], 1).sum())
        return 4 * parts * self.compared * int(self.tree.feature.shape[1])

    def poses(self, nodes: Nodes, level: int) -> Array:
        """How many poses nodes hold at most."""
        side = 1 << level
        return np.asarray(self.tree.leaves[nodes[:, 0]] * float(min(side, self.ny) * min(side, self.nx)))

    def last_cells(self, poses: Nodes) -> Nodes:
        """(course, row, column) of the last sample."""
        return poses - np.pad(self.tree.middle[poses[:, 0]][:, (0, 2)], ((0, 0), (1, 0)))


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
    on_planes, expected = _on_planes(planes, window, courses, prior, error, budget)
    patience = _Patience(out_of_time)
    sweep = _Sweep(2.0 * window_nats, capacity // len(planes), budget, patience, expected)
    found = sweep.over(on_planes)
    if not any(len(poses) and costs.min() <= expected for poses, costs in found):  # nothing matches that well
        sweep = _Sweep(2.0 * window_nats, capacity // len(planes), budget - sweep.used, patience, None)
        found = sweep.over(on_planes)
    plane = np.concatenate([np.full(len(poses), k) for k, (poses, _) in enumerate(found)])
    poses = np.concatenate([on_planes[k].last_cells(poses) for k, (poses, _) in enumerate(found)]).astype(np.int64)
    cost = np.concatenate([cost for _, cost in found])
    inside = cost <= sweep.best + sweep.window
    order = np.flatnonzero(inside)
    order = order[np.lexsort((poses[order, 2], poses[order, 1], poses[order, 0], plane[order], cost[order]))]
    sweep.miss(np.ones(len(cost) - len(order)), cost[~inside])
    return Candidates(
        plane=plane[order],
        course=poses[order, 0],
        row=poses[order, 1],
        column=poses[order, 2],
        score=-0.5 * cost[order],
        window_nats=0.5 * sweep.window,
        complete=sweep.reach > sweep.best + sweep.asked and not sweep.patience.ended,
        missed_mass=sweep.missed_mass,
        poses=len(courses) * sum(p.shape[0] * p.shape[1] for p in planes),
    )


def _on_planes(
    planes: Sequence[Plane], window: ReducedWindow, courses: Courses, prior: PosePrior, error: WindowError, budget: int
) -> tuple[list[_OnPlane], float]:
    """The planes with the trees over them, one tree for all of a resolution; and the cost of a pose that matches."""
    order = telling_order(window, planes[0])
    along = np.abs(window.path_m - 0.5 * (window.path_m[0] + window.path_m[-1]))
    trees: dict[float, CourseTree] = {}
    on_planes, expected = [], -np.inf
    for plane, walkable in zip(planes, prior.walkable or (None,) * len(planes), strict=True):
        scene, usual = make_scene(plane, window, order, prior, error, walkable)
        if plane.resolution_m not in trees:
            steep = max(p.gradient_uT_per_m for p in planes) * plane.resolution_m
            trees[plane.resolution_m] = course_tree(
                courses, turn_window(window, courses, plane.resolution_m), order, int(np.argmin(along)),
                plane.pyramid.places, len(plane.pyramid.doubling) - 1, 1.0 / max(steep, 1e-3),
                _SHARE, scene.headed,
            )  # fmt: skip
        tree = trees[plane.resolution_m]
        on_planes.append(_OnPlane(scene, tree, window.features_uT.shape[1], _top(plane, window, tree, budget)))
        expected = max(expected, usual)
    return on_planes, expected


def _top(plane: Plane, window: ReducedWindow, tree: CourseTree, budget: int) -> int:
    """The level to start from: larger blocks where the budget does not allow more."""
    ny, nx = plane.shape
    level = min(_TOP, len(tree.stages) - 1)
    while level < len(tree.stages) - 1:
        stage = tree.stages[level]
        blocks = ((ny >> level) + 2) * ((nx >> level) + 2)
        if (stage.last - stage.first) * blocks * window.features_uT.size <= _TOP_SHARE * budget:
            break
        level += 1
    return level


class _Patience:
    """Whether the caller still waits; once it does not, it never does again."""

    def __init__(self, out_of_time: Callable[[], bool] | None) -> None:
        self._out_of_time = out_of_time
        self.ended = False

    def over(self) -> bool:
        self.ended = self.ended or (self._out_of_time is not None and self._out_of_time())
        return self.ended


@dataclass(slots=True, eq=False)
class _Start:
    """The top nodes of a plane that may matter with their bounds, and what these took of the budget."""

    nodes: Nodes
    bounds: Array
    used: int

    @property
    def least(self) -> float:
        return float(self.bounds.min()) if len(self.bounds) else np.inf


class _Sweep:
    """Level by level over one plane after the other; the incumbent and the window carry over.

    The incumbent's cost is at first `assumed`, that of a pose which matches; without that a pose is looked for.
    """

    def __init__(self, asked: float, capacity: int, budget: int, patience: _Patience, assumed: float | None) -> None:
        self.asked, self.capacity, self.budget, self.patience = asked, max(capacity, 1), budget, patience
        self.assumed, self.best = assumed is not None, np.inf if assumed is None else assumed
        self.reach = np.inf  # cost from which poses were left out for want of room, budget or time
        self.used = 0  # of the budget, on the plane that took most
        self.missed_mass = 0.0  # at most, relative to the best pose

    @property
    def window(self) -> float:
        return max(min(self.asked, self.reach - self.best), 0.0)

    def over(self, on_planes: Sequence[_OnPlane]) -> list[tuple[Nodes, Array]]:
        """Per plane the poses within the window of the best so far, with their costs; the most promising plane
        first."""
        found: list[tuple[Nodes, Array]] = [(np.empty((0, 3), np.int32), np.empty(0))] * len(on_planes)
        if not self.assumed:
            found = [self._seed(on_plane) for on_plane in on_planes]
        starts = [self._start(on_plane) for on_plane in on_planes]
        promise = [start.least for start in starts]
        if len(on_planes) > 1:  # a good pose of the right plane first: the others are pruned by it
            for k, (on_plane, start) in enumerate(zip(on_planes, starts, strict=True)):
                pose, promise[k] = self._dive(on_plane, start)
                if promise[k] < self.best:
                    found[k] = pose, np.array([promise[k]])
                    self._improve(promise[k])
        for k in np.argsort(promise, kind="stable"):
            found[k] = self._run(on_planes[k], starts[k], *found[k])
        return found

    @staticmethod
    def _dive(on_plane: _OnPlane, start: _Start) -> tuple[Nodes, float]:
        """A good pose of a plane (1, 3) and its cost."""
        if not len(start.nodes):
            return start.nodes, np.inf
        return on_plane.dive(start.nodes, start.bounds, on_plane.top, np.inf, _WIDE)

    def _seed(self, on_plane: _OnPlane) -> tuple[Nodes, Array]:
        pose, cost = on_plane.seed()
        if len(pose):
            self._improve(cost)
        return pose, np.full(len(pose), cost)

    def _start(self, on_plane: _OnPlane) -> _Start:
        """The top nodes that may matter; groups that are not reached in time are left out, by what their
        priors cost."""
        found, used, at, stage = [], 0, on_plane.stage.first, on_plane.stage
        step = max(8 * _CHUNK // (on_plane.area[2] * on_plane.area[3]), 1)
        while at < stage.last and not self.patience.over():
            nodes, bounds, compared, missed = on_plane.start(at, min(at + step, stage.last), self.best, self.window)
            found.append((nodes, bounds))
            used, at, self.missed_mass = used + compared, at + step, self.missed_mass + missed
        if at < stage.last:
            left = on_plane.tree.cost[at : stage.last] + on_plane.scene.constant
            self.miss(np.asarray(on_plane.tree.leaves[at : stage.last] * float(on_plane.ny * on_plane.nx)), left)
            self.reach = min(self.reach, float(left.min()))
        return _Start(*_joined(found), used)

    def _run(self, on_plane: _OnPlane, start: _Start, seed: Nodes, seed_cost: Array) -> tuple[Nodes, Array]:
        nodes, bounds, left = start.nodes, start.bounds, self.budget - start.used
        for level in range(on_plane.top - 1, -1, -1):
            nodes, bounds = self._fit(on_plane, nodes, bounds, level + 1)
            if len(nodes) > _DIVE_AGAIN or (self.assumed and len(nodes) > _BEAM):
                pose, cost = on_plane.dive(nodes, bounds, level + 1, self.best, _WIDE)
                if cost < self.best:
                    seed, seed_cost = pose, np.array([cost])
                    self._improve(cost)
            nodes, bounds, used = self._split(on_plane, nodes, bounds, level, max(left, 0) // (level + 1))
            left -= used
        self.used = max(self.used, self.budget - left)
        if len(seed) and not (nodes == seed).all(axis=1).any():
            nodes, bounds = np.concatenate([seed, nodes]), np.concatenate([seed_cost, bounds])
        keep = self._keep(bounds, self.capacity)
        self.miss(np.ones(len(bounds) - int(keep.sum())), bounds[~keep])
        return nodes[keep], bounds[keep]

    def miss(self, poses: Array, bounds: Array) -> None:
        """Count nodes of so many poses that are left out, by their bounds."""
        near = bounds < self.best + 2.0 * _NEGLIGIBLE_NATS
        self.missed_mass += float(poses[near] @ np.exp(np.minimum(0.5 * (self.best - bounds[near]), 300.0)))

    def _split(
        self, on_plane: _OnPlane, nodes: Nodes, bounds: Array, level: int, allowed: int
    ) -> tuple[Nodes, Array, int]:
        """The parts of nodes that are worth following, their bounds, and the values compared, hardly more than
        allowed. What is not reached, by the budget or in time, is left out, the least promising first."""
        if on_plane.most(nodes) > allowed:
            order = np.argsort(bounds, kind="stable")
            nodes, bounds = nodes[order], bounds[order]
        found: list[tuple[Nodes, Array]] = []
        done = used = 0
        while done < len(nodes) and used < allowed and not self.patience.over():
            part = nodes[done : done + _CHUNK]
            parts, costs, reached, compared, missed, least = on_plane.split(
                part, level, self.best, self.window, allowed - used
            )
            found.append((parts, costs))
            done, used, self.missed_mass = done + reached, used + compared, self.missed_mass + missed
            if level == 0:
                self._improve(least)
        if done < len(nodes):
            self._leave(on_plane, nodes[done:], bounds[done:], level + 1)
        return *_joined(found), used

    def _leave(self, on_plane: _OnPlane, nodes: Nodes, bounds: Array, level: int) -> None:
        """Leave out nodes that were not reached: the window ends where they may begin."""
        self.miss(on_plane.poses(nodes, level), bounds)
        self.reach = min(self.reach, float(bounds.min()))

    def _fit(self, on_plane: _OnPlane, nodes: Nodes, bounds: Array, level: int) -> tuple[Nodes, Array]:
        """No more than there is room for: the window shrinks."""
        if len(nodes) > _MOST_NODES:
            keep = self._keep(bounds, _MOST_NODES)
            self.miss(on_plane.poses(nodes[~keep], level), bounds[~keep])
            nodes, bounds = nodes[keep], bounds[keep]
        return nodes, bounds

    def _improve(self, cost: float) -> None:
        if cost < self.best:
            self.missed_mass *= float(np.exp(0.5 * (cost - self.best)))
            self.best, self.assumed = cost, False

    def _keep(self, bounds: Array, room: int) -> NDArray[np.bool_]:
        """Which to follow: those within the window, which shrinks when they are more than there is room for."""
        keep = bounds <= self.best + self.window
        if keep.sum() <= room:
            return keep
        self.reach = min(self.reach, float(np.partition(bounds, room)[room]))
        chosen = np.flatnonzero(bounds <= self.best + self.window)
        if len(chosen) > room:  # as good as equal: some of them, evenly
            chosen = chosen[np.linspace(0, len(chosen) - 1, room).astype(np.int64)]
        keep[:] = False
        keep[chosen] = True
        return keep


def _joined(parts: list[tuple[Nodes, Array]]) -> tuple[Nodes, Array]:
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return np.empty((0, 3), np.int32), np.empty(0)
    return np.concatenate([nodes for nodes, _ in parts]), np.concatenate([bounds for _, bounds in parts])
