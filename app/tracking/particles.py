"""Particles that carry what is integrated exactly (Rao-Blackwell): the sensor's offset, errors alike along the walk.

A particle is a pose. Given its path, readings are a linear Gaussian function of an offset b, constant in the sensor's
axes, and of two processes of unit variance, of correlations exp(-d / l) over the distance walked:
    T_k (z_k - R(-heading) m(p)) = b + sigma(p) v_k + s(p) f_k + white noise,
so each particle has a Kalman filter over (b, v, f), whose covariance all components share. v is walk noise: with b this
is the covariance that windows are scored under (`app.positioning.window_error`), told step after step. f is the field
itself where nothing is mapped, as smooth as the map is: such a place predicts what a smooth field would, under the same
errors as a place that is mapped, and gains nothing over it.
"""

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.tracking.ground import Barriers
from app.tracking.particle_filter import normalise, systematic_ancestors
from app.tracking.places import Places

__all__ = [
    "BETWEEN_FLOORS_M", "COLUMNS", "COURSE", "DRAWS", "DRIFT", "HEADING", "MEASURED", "SCALE", "X", "Y", "Z", "Advance",
    "Particles", "advance", "log_evidence", "new_particles", "resample", "weights",
]  # fmt: skip

X, Y, Z, HEADING, COURSE, SCALE, DRIFT, MEASURED = 0, 1, 2, 3, 4, 5, 6, 7
_BB, _BV, _BF, _VV, _VF, _FF, _B, _V, _F = 8, 9, 10, 11, 12, 13, 14, 17, 20
COLUMNS = 23
DRAWS = 5
_CROSSING = 8.0  # nats that a path through a wall costs: plans err, too
BETWEEN_FLOORS_M = 1.0  # this far above or below the map of a floor nothing is mapped
_MEASURED_M = 5.0  # over which "measured" is remembered


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """rows (n, COLUMNS): position, yaw of the track's frame, scale and drift of its displacements; how much of its last

    metres was measured; variances and means of offset and process. floor (n,): index. log_weight (n,), not normalised.
    """

    rows: Array
    floor: NDArray[np.int64]
    log_weight: Array

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def position_m(self) -> Array:
        return self.rows[:, :2]


@dataclass(frozen=True, slots=True, eq=False)
class Advance:
    """What moves all particles, and the reading at its end.

    moved_m       (2,) in the track's frame; distance_m its length, or what may have been walked unseen
    risen_m       height gained
    features_uT   (c,) scaled, in the track's frame, or None: nothing was measured
    noise_uT2     variance of those
    turn          (3, 3) rotation of the track's axes to the sensor's
    walk          (6,) sds of this move's random walk of heading and of position along each axis; how much of course
                  and scale is kept, and the sds of what is new of each
    turns         whether a heading turns the features
    strays        nats that this move costs on ground where nothing is mapped
    """

    moved_m: Array
    distance_m: float
    risen_m: float
    features_uT: Array | None
    noise_uT2: float
    turn: Array
    walk: Array
    turns: bool
    strays: float = 0.0


def new_particles(
    position_m: Array, floor: NDArray[np.int64], heading_rad: Array, offset_variance_uT2: float
) -> Particles:
    """Of one weight, at positions (n, 3)."""
    rows = np.zeros((len(position_m), COLUMNS))
    rows[:, :3], rows[:, HEADING], rows[:, SCALE], rows[:, MEASURED] = position_m, heading_rad, 1.0, 1.0
    rows[:, _BB], rows[:, _VV], rows[:, _FF] = offset_variance_uT2, 1.0, 1.0
    return Particles(rows, np.asarray(floor, dtype=np.int64), np.zeros(len(rows)))


def advance(
    particles: Particles, move: Advance, places: Places, barriers: Barriers, noise: NDArray[np.float32],
    innovation: Array | None = None,
) -> Particles:  # fmt: skip
    """Move particles and weigh them by the reading; noise (n, DRAWS) standard normal numbers.

    innovation (n, 2), if given, is filled with the squares of each particle's innovation and their variance.
    """
    rows, log_weight = particles.rows.copy(), particles.log_weight.copy()
    features = np.zeros(0) if move.features_uT is None else move.features_uT
    told = np.zeros((0, 2)) if innovation is None else innovation
    _advance(
        rows, particles.floor, log_weight, move.moved_m, move.distance_m, move.risen_m, features, move.noise_uT2,
        np.ascontiguousarray(move.turn), move.walk, move.turns, move.strays, noise, places.cells, places.planes,
        places.shapes, places.floors, places.resolution_m, places.errors, len(places.scale), barriers, told,
    )  # fmt: skip
    return Particles(rows, particles.floor, log_weight)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _advance(  # type: ignore[no-untyped-def]
    rows, floor, log_weight, moved, distance, risen, features, noise_uT2, turn, walk, turns, strays, noise, cells,
    planes, shapes, floors, resolution, errors, c, barriers, told,
):  # fmt: skip
    n = len(rows)
    observed = len(features) > 0
    walked = len(barriers.segments) > 0
    forget = np.exp(-distance / _MEASURED_M)
    fade_v, fade_f = np.exp(-distance * errors[2]), np.exp(-distance * errors[4])
    mean, apart = np.zeros(3), np.zeros(3)
    for i in range(n):
        row = rows[i]
        heading = row[HEADING] + 0.5 * row[DRIFT] * distance + walk[0] * noise[i, 0]
        row[COURSE] = walk[2] * row[COURSE] + walk[3] * noise[i, 3]
        row[SCALE] = 1.0 + walk[4] * (row[SCALE] - 1.0) + walk[5] * noise[i, 4]
        scale = row[SCALE]
        cosine, sine = np.cos(heading + row[COURSE]), np.sin(heading + row[COURSE])
        x = row[X] + scale * (cosine * moved[0] - sine * moved[1]) + walk[1] * noise[i, 1]
        y = row[Y] + scale * (sine * moved[0] + cosine * moved[1]) + walk[1] * noise[i, 2]
        if walked and _crosses(row[X], row[Y], x, y, floor[i], barriers):
            log_weight[i] -= _CROSSING
        row[X], row[Y] = x, y
        row[HEADING] = heading + 0.5 * row[DRIFT] * distance
        row[Z] += risen
        if not observed:
            continue
        variance, measured = _look_up(x, y, row[Z], floor[i], cells, planes, shapes, floors, resolution, c, mean)
        below, above = floors[floor[i], 0], floors[floor[i], 0] + floors[floor[i], 1] - 1
        on_floor = planes[below, 2] - BETWEEN_FLOORS_M < row[Z] < planes[above, 2] + BETWEEN_FLOORS_M
        if on_floor:
            log_weight[i] -= strays * (1.0 - measured)
        else:
            measured = 0.0
        row[MEASURED] = forget * row[MEASURED] + (1.0 - forget) * measured
        sigma = np.sqrt(errors[0] * variance)
        spread = errors[3] * np.sqrt(max(1.0 - measured, 0.0))
        white = errors[1] * variance + noise_uT2
        bb, bv, bf = row[_BB], fade_v * row[_BV], fade_f * row[_BF]
        vv, vf = fade_v * fade_v * row[_VV] + 1.0 - fade_v * fade_v, fade_v * fade_f * row[_VF]
        ff = fade_f * fade_f * row[_FF] + 1.0 - fade_f * fade_f
        to_b, to_v, to_f = bb + sigma * bv + spread * bf, bv + sigma * vv + spread * vf, bf + sigma * vf + spread * ff
        total = to_b + sigma * to_v + spread * to_f + white
        gain_b, gain_v, gain_f = to_b / total, to_v / total, to_f / total
        row[_BB], row[_BV], row[_BF] = bb - gain_b * to_b, bv - gain_b * to_v, bf - gain_b * to_f
        row[_VV], row[_VF], row[_FF] = vv - gain_v * to_v, vf - gain_v * to_f, ff - gain_f * to_f
        if turns:
            heading = row[HEADING]
            cosine, sine = np.cos(heading), np.sin(heading)
            mx = cosine * mean[0] + sine * mean[1]
            mean[1] = -sine * mean[0] + cosine * mean[1]
            mean[0] = mx
        for k in range(c):
            apart[k] = features[k] - mean[k]
        squares = 0.0
        for k in range(c):
            y_k = apart[k]
            if c == 3:
                y_k = turn[k, 0] * apart[0] + turn[k, 1] * apart[1] + turn[k, 2] * apart[2]
            v_k, f_k = fade_v * row[_V + k], fade_f * row[_F + k]
            y_k -= row[_B + k] + sigma * v_k + spread * f_k
            row[_B + k] += gain_b * y_k
            row[_V + k] = v_k + gain_v * y_k
            row[_F + k] = f_k + gain_f * y_k
            squares += y_k * y_k
        log_weight[i] -= 0.5 * (squares / total + c * np.log(6.283185307179586 * total))
        if len(told) > 0:
            told[i, 0], told[i, 1] = squares, total


@numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _look_up(x, y, z, floor, cells, planes, shapes, floors, resolution, c, mean):  # type: ignore[no-untyped-def]
    """Features at a place into `mean`; returns the variance of a measurement there and how much of it is measured."""
    first, count = floors[floor, 0], floors[floor, 1]
    below, above, share = first, first, 0.0
    if count > 1:
        while above < first + count - 1 and planes[above, 2] < z:
            above += 1
        below = max(above - 1, first)
        gap = planes[above, 2] - planes[below, 2]
        share = min(max((z - planes[below, 2]) / gap, 0.0), 1.0) if gap > 0.0 else 0.0
    for k in range(c):
        mean[k] = 0.0
    variance, measured = 0.0, 0.0
    width = c + 2
    for layer in range(2):
        plane, part = (below, 1.0 - share) if layer == 0 else (above, share)
        if part == 0.0:
            continue
        start, ny, nx = shapes[plane, 0], shapes[plane, 1], shapes[plane, 2]
        u, v = (x - planes[plane, 0]) / resolution[plane], (y - planes[plane, 1]) / resolution[plane]
        i, j = int(np.floor(u)), int(np.floor(v))
        fu, fv = u - i, v - j
        for corner in range(4):
            di, dj = corner & 1, corner >> 1
            w = (fu if di else 1.0 - fu) * (fv if dj else 1.0 - fv) * part
            # Beyond the edge nothing is measured: the nearest cell lends its values, and its mark is not counted.
            a, b = min(max(j + dj, 0), ny - 1), min(max(i + di, 0), nx - 1)
            at = start + (a * nx + b) * width
            for k in range(c):
                mean[k] += w * cells[at + k]
            variance += w * cells[at + c]
            if a == j + dj and b == i + di:
                measured += w * cells[at + c + 1]
    return variance, measured


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _crosses(x0, y0, x1, y1, floor, barriers):  # type: ignore[no-untyped-def]
    """Whether the way from one point to another meets a segment of the floor."""
    frame = barriers.frame[floor]
    rows, columns = int(frame[2]), int(frame[3])
    if rows == 0:
        return False
    size = 2.0  # of a bucket
    left, right = int(np.floor((min(x0, x1) - frame[0]) / size)), int(np.floor((max(x0, x1) - frame[0]) / size))
    low, high = int(np.floor((min(y0, y1) - frame[1]) / size)), int(np.floor((max(y0, y1) - frame[1]) / size))
    dx, dy = x1 - x0, y1 - y0
    for j in range(max(low, 0), min(high, rows - 1) + 1):
        for i in range(max(left, 0), min(right, columns - 1) + 1):
            bucket = int(frame[4]) + j * columns + i
            for m in range(barriers.first[bucket], barriers.first[bucket + 1]):
                ax, ay, bx, by = barriers.segments[barriers.members[m]]
                ex, ey = bx - ax, by - ay
                across = dx * ey - dy * ex
                if across == 0.0:
                    continue
                t = ((ax - x0) * ey - (ay - y0) * ex) / across
                s = ((ax - x0) * dy - (ay - y0) * dx) / across
                if 0.0 <= t <= 1.0 and 0.0 <= s <= 1.0:
                    return True
    return False


def weights(particles: Particles) -> Array:
    """(n,) normalised."""
    return normalise(particles.log_weight).weight


def log_evidence(particles: Particles) -> float:
    """Log of the sum of the weights."""
    return normalise(particles.log_weight).log_sum


def resample(particles: Particles, weight: Array, count: int, draw: float) -> tuple[Particles, NDArray[np.int64]]:
    """Systematic resampling with one uniform draw: `count` particles of one weight, together as heavy as the old ones;

    and from which each was drawn.
    """
    chosen = systematic_ancestors(weight, draw, count)
    even = np.full(count, log_evidence(particles) - np.log(count))
    return replace(particles, rows=particles.rows[chosen], floor=particles.floor[chosen], log_weight=even), chosen
