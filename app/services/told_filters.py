"""Filters that cannot find themselves: they are told the true place and heading of the first step, which flatters them.

`KalmanFixes`        constant velocity, corrected by the likeliest cell around the belief (Storms); turns are told
`MadContour`         the believed path's best parallel by mean absolute deviation, then the nearest contour (Cuenca),
                     with the reckoned displacement where the source integrates an IMU
`DeadReckoningOnly`  no map at all
"""

from dataclasses import dataclass, replace

import numpy as np

from app.geometry import Array, yaw_matrix
from app.services.filter_floors import OFF_FLOOR_M, Floor, moves, nearest_floor, own_state, radius_95_m
from app.services.followed_walks import Rows, Start, ToldWhat, rows_of
from app.tracking.contour_matching import GmaHistory, gan_fix, square_offsets_m
from app.tracking.kalman import GaussianBelief, update
from app.tracking.ml_kalman import MlKalman, start_belief
from app.tracking.options import TrackOptions
from app.tracking.position_fix import FixSettings
from app.tracking.step import Step

__all__ = ["DeadReckoningOnly", "KalmanFixes", "MadContour"]


@dataclass(frozen=True, slots=True, eq=False)
class KalmanFixes:
    """Constant velocity from the told place, walking as the device was first turned, and as fast as it first reckons.

    Told turns are the gyroscope's; readings are turned by the told heading, as in the source, which takes it as known.
    """

    floors: tuple[Floor, ...]
    options: TrackOptions
    acceleration_psd_m2_s3: float = 0.05
    name: str = "Kalman, ML fixes"
    told: ToldWhat = "start, heading"

    def follow_walk(self, steps: tuple[Step, ...], start: Start) -> Rows:
        turn = yaw_matrix(start.heading_rad)
        filters = [self._on(each) for each in self.floors]
        belief = start_belief(np.array(start.position_m), turn[:2, :2] @ _first_velocity_m_s(steps), 0.5, 0.5)
        k, height_m = start.floor, self.floors[start.floor].height_m
        floor, position, covariance, says = [], [], [], []
        for move in moves(steps, self.floors[k].apart_m):
            height_m += float(move.moved_m[2])
            k = nearest_floor(self.floors, height_m, k)
            if move.elapsed_s > 0.0:
                belief = filters[k].advance(belief, move.elapsed_s, turn_rad=move.turned_rad)
            if move.compared and abs(height_m - self.floors[k].height_m) <= OFF_FLOOR_M:
                assert move.step.B_uT is not None
                belief = filters[k].correct(belief, turn @ move.step.B_uT).belief
            floor.append(k)
            position.append(belief.position_m)
            covariance.append(belief.position_covariance_m2)
            says.append(own_state(radius_95_m(belief.position_covariance_m2), self.options))
        return rows_of(steps, floor, position, covariance, says)

    def _on(self, floor: Floor) -> MlKalman:
        noise = float(np.sqrt(np.mean(floor.variance_uT2(self.options))))
        settings = FixSettings(noise_sd_uT=noise, least_reach_m=1.5 * floor.grid.resolution_m,
                               slice_half_m=max(1.5, 4.0 * floor.grid.resolution_m))  # fmt: skip
        return MlKalman(floor.cells, settings, self.acceleration_psd_m2_s3)


def _first_velocity_m_s(steps: tuple[Step, ...], within_s: float = 4.0) -> Array:
    """(2,) in the track's frame, as reckoned over the first seconds."""
    early = [step for step in steps if step.t_s <= steps[0].t_s + within_s]
    first, last = early[0], early[-1]
    assert first.displacement_m is not None
    assert last.displacement_m is not None
    return np.asarray((last.displacement_m - first.displacement_m)[:2] / max(last.t_s - first.t_s, 1e-3))


@dataclass(frozen=True, slots=True, eq=False)
class MadContour:
    """GMA and NEDP on the magnitude along ten metres of the believed path; each match is used once (`batches`).

    side, spacing_m   of the square of parallel paths; the source's is 1 m wide, on maps of 0.1 m
    drift_m           sd per axis and square root of metre that the reckoning strays by
    """

    floors: tuple[Floor, ...]
    options: TrackOptions
    length_m: float = 10.0
    side: int = 11
    spacing_m: float = 0.5
    drift_m: float = 0.3
    name: str = "MAD + contour"
    told: ToldWhat = "start, heading"

    def follow_walk(self, steps: tuple[Step, ...], start: Start) -> Rows:
        turn = yaw_matrix(start.heading_rad)
        k, height_m = start.floor, self.floors[start.floor].height_m
        history = GmaHistory(square_offsets_m(self.side, self.spacing_m), round(self.length_m / self.floors[k].apart_m))
        belief = GaussianBelief(np.array(start.position_m), 0.1**2 * np.eye(2))
        floor, position, covariance, says = [], [], [], []
        for move in moves(steps, self.floors[k].apart_m):
            height_m += float(move.moved_m[2])
            now = nearest_floor(self.floors, height_m, k)
            history, k = (history if now == k else history.forgotten()), now
            way = (turn @ move.moved_m)[:2]
            spread = self.drift_m**2 * float(np.hypot(*way)) * np.eye(2)
            belief = GaussianBelief(belief.mean + way, belief.covariance + spread)
            if move.compared and abs(height_m - self.floors[k].height_m) <= OFF_FLOOR_M:
                belief, history = self._matched(belief, history, self.floors[k], move.step)
            floor.append(k)
            position.append(belief.mean)
            covariance.append(belief.covariance)
            says.append(own_state(radius_95_m(belief.covariance), self.options))
        return rows_of(steps, floor, position, covariance, says)

    def _matched(
        self, belief: GaussianBelief, history: GmaHistory, floor: Floor, step: Step
    ) -> tuple[GaussianBelief, GmaHistory]:
        assert step.B_uT is not None
        norm_uT, r = float(np.linalg.norm(step.B_uT)), floor.grid.resolution_m
        history = history.push(floor.norm, belief.mean, norm_uT)
        if not history.full:
            return belief, history
        fix = gan_fix(history, floor.norm, belief.mean, norm_uT, self.options.noise_uT, reach_m=max(0.5, 2.0 * r))
        if fix is None:
            return belief, replace(history, residual_uT=history.residual_uT[:, 1:])
        R = max(0.25, r**2) * np.eye(2)
        return update(belief, fix.position_m, np.eye(2), R).belief, history.forgotten()


@dataclass(frozen=True, slots=True, eq=False)
class DeadReckoningOnly:
    """No map: the told start carried on by the device's own reckoning, whose errors grow as `options` say."""

    floors: tuple[Floor, ...]
    options: TrackOptions
    name: str = "dead reckoning"
    told: ToldWhat = "start, heading"

    def follow_walk(self, steps: tuple[Step, ...], start: Start) -> Rows:
        way = np.array([step.displacement_m for step in steps])
        turned = (way - way[0]) @ yaw_matrix(start.heading_rad).T
        heights = np.array([floor.height_m for floor in self.floors])
        z = heights[start.floor] + turned[:, 2]
        floor = np.argmin(np.abs(z[:, None] - heights), axis=1)
        if len(set(heights)) < len(heights):  # maps without heights: nothing tells floors apart
            floor = np.full(len(steps), start.floor)
        covariance = _reckoned_covariance_m2(turned[:, :2], self.options)
        state = tuple(own_state(radius_95_m(each), self.options) for each in covariance)
        t_s = np.array([step.t_s for step in steps])
        return Rows(t_s, floor.astype(np.int64), np.array(start.position_m) + turned[:, :2], covariance, state)


def _reckoned_covariance_m2(place_m: Array, options: TrackOptions) -> Array:
    """(n, 2, 2) of a path (n, 2) from its start: scale, course, drift of the heading, and both random walks."""
    length = np.linalg.norm(np.diff(place_m, axis=0, prepend=place_m[:1]), axis=1)
    way = np.diff(place_m, axis=0, prepend=place_m[:1])
    path = np.cumsum(length)
    swept = _across(np.cumsum(path[:, None] * way, axis=0))
    scale, course = place_m, _across(place_m)
    out = options.step_scale_sd**2 * _outer(scale) + options.course_sd_rad**2 * _outer(course)
    out += options.heading_drift_sd_rad_per_m**2 * _outer(swept)
    mean = np.cumsum(length[:, None] * place_m, axis=0)
    cross = np.einsum("ni,nj->nij", place_m, mean)
    square = np.cumsum(length[:, None, None] * _outer(place_m), axis=0)
    lever = path[:, None, None] * _outer(place_m) - cross - cross.transpose(0, 2, 1) + square
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    out += options.heading_walk_rad**2 * turn @ lever @ turn.T
    out += (options.position_walk_m**2 * path + 0.1**2)[:, None, None] * np.eye(2)
    return np.asarray(out)


def _across(v: Array) -> Array:
    return np.column_stack([-v[:, 1], v[:, 0]])


def _outer(v: Array) -> Array:
    return np.asarray(np.einsum("ni,nj->nij", v, v))
