"""The bootstrap particle filter of the sources, on steps of a device that reckons its own displacement."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from app.geometry import Array
from app.services.filter_floors import OFF_FLOOR_M, Floor, moves, own_state, radius_95_m
from app.services.followed_walks import Rows, Start, ToldWhat, rows_of
from app.tracking.field_likelihood import log_likelihood, neutral, turned
from app.tracking.field_lookup import look_up
from app.tracking.motion import Displacement
from app.tracking.options import TrackOptions
from app.tracking.particle_filter import Particles, estimate, normalise, update
from app.tracking.step import Step

__all__ = ["SourceParticles"]

X, Y, HEADING, SCALE, Z, FLOOR = range(6)


@dataclass(frozen=True, slots=True, eq=False)
class SourceParticles:
    """Uniform over measured cells and, without a compass, over headings; the map's variance is in the weight.

    It moves when a reading is compared, and between readings its place is carried on by the mean heading and scale.
    Where nothing is mapped a reading is as likely as a draw from the map's prior; between floors it tells nothing.
    Its place is the weighted mean on the floor that most of the weight is on. `jitter_sd` is of its state: x, y,
    heading, scale, height, floor.
    """

    floors: tuple[Floor, ...]
    options: TrackOptions
    particles: int = 20_000
    seed: int = 0
    motion: Displacement = field(default_factory=Displacement)
    jitter_sd: tuple[float, ...] = (0.1, 0.1, 0.02, 0.005, 0.0, 0.0)
    name: str = "particle filter"
    told: ToldWhat = "nothing"

    def follow_walk(self, steps: tuple[Step, ...], start: Start) -> Rows:
        rng = np.random.default_rng(self.seed)
        cloud = self._anywhere(steps[0], rng)
        said, since_m, since_s, last = [], np.zeros(3), 0.0, self._says(cloud)
        for move in moves(steps, self.floors[0].apart_m):
            since_m, since_s = since_m + move.moved_m, since_s + move.elapsed_s
            if move.compared:
                if since_m.any():
                    cloud = Particles(self._moved(cloud.state, since_m, since_s, rng), cloud.log_weight)
                likely = self._log_likelihood(cloud, move.step)
                cloud = update(cloud, likely, rng, jitter_sd=np.array(self.jitter_sd)).particles
                since_m, since_s, last = np.zeros(3), 0.0, self._says(cloud)
            said.append((last.floor, last.position_m + last.turn @ since_m[:2], last.covariance_m2, last.state))
        floor, position, covariance, says = (list(each) for each in zip(*said, strict=True))
        return rows_of(steps, floor, position, covariance, says)

    def _anywhere(self, step: Step, rng: np.random.Generator) -> Particles:
        cells = [np.argwhere(each.cells.known) for each in self.floors]
        areas = np.array([len(c) * f.grid.resolution_m**2 for c, f in zip(cells, self.floors, strict=True)])
        state = np.empty((self.particles, 6))
        state[:, FLOOR] = rng.choice(len(cells), self.particles, p=areas / areas.sum())
        for k, each in enumerate(self.floors):
            here = np.flatnonzero(state[:, FLOOR] == k)
            cell = cells[k][rng.integers(len(cells[k]), size=len(here))] + rng.uniform(-0.5, 0.5, (len(here), 2))
            state[here, :2] = np.asarray(each.cells.origin_m) + each.grid.resolution_m * cell[:, ::-1]
            state[here, Z] = each.height_m
        state[:, HEADING] = rng.uniform(-np.pi, np.pi, self.particles)
        if step.heading_rad is not None:
            state[:, HEADING] = step.heading_rad + (step.heading_sd_rad or 0.0) * rng.standard_normal(self.particles)
        state[:, SCALE] = 1.0 + self.options.step_scale_sd * rng.standard_normal(self.particles)
        return Particles.equal(state)

    def _moved(self, state: Array, moved_m: Array, elapsed_s: float, rng: np.random.Generator) -> Array:
        plane = self.motion.propagate(state[:, :Z], moved_m[:2], rng, elapsed_s)
        height, floor = state[:, Z] + moved_m[2], state[:, FLOOR]
        heights = np.array([each.height_m for each in self.floors])
        if moved_m[2] != 0.0 and len(set(heights)) == len(heights):
            floor = np.argmin(np.abs(height[:, None] - heights), axis=1).astype(np.float64)
        return np.column_stack([plane, height, floor])

    def _log_likelihood(self, cloud: Particles, step: Step) -> Array:
        assert step.B_uT is not None
        state, n = cloud.state, len(cloud)
        log_l, on_floor = np.zeros(n), np.zeros(n, dtype=np.bool_)
        for k, each in enumerate(self.floors):
            here = np.flatnonzero(state[:, FLOOR] == k)
            looked = look_up(each.table, state[here][:, [X, Y, Z]])
            reading = turned(step.B_uT, state[here, HEADING])
            log_l[here] = log_likelihood(looked, reading, each.variance_uT2(self.options))
            on_floor[here] = np.abs(state[here, Z] - each.height_m) <= OFF_FLOOR_M
        return neutral(log_l, on_floor, cloud.log_weight)

    def _says(self, cloud: Particles) -> "_Said":
        weight, floor = normalise(cloud.log_weight).weight, cloud.state[:, FLOOR]
        best = int(np.argmax(np.bincount(floor.astype(np.int64), weights=weight)))
        here = floor == best
        share = float(weight[here].sum())
        found = estimate(cloud.state[here, :2], weight[here] / share)
        sure = share >= self.options.converged_probability
        radius_m = radius_95_m(found.covariance) if sure else np.inf
        turn = weight[here] * cloud.state[here, SCALE] @ np.exp(1j * cloud.state[here, HEADING]) / share
        rotation = np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
        return _Said(best, found.mean, found.covariance, own_state(radius_m, self.options), rotation)


class _Said(NamedTuple):
    """The belief at a reading; turn (2, 2) carries the place on by displacements until the next one."""

    floor: int
    position_m: Array
    covariance_m2: Array
    state: str
    turn: Array
