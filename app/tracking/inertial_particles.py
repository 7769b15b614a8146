"""Particles for a device with a levelled accelerometer, a drone or a robot: what is linear is integrated exactly.

A particle is a position. Given its path, velocity v and accelerometer bias a are linear Gaussian functions of the steps
it made, and readings are of the magnetometer's offset b and walk noise w (Schoen, Gustafsson and Nordlund 2005):
    v' = v + T (mean acceleration - a) + noise,     p' = p + T v + (moved by the acceleration less a) + noise,
    z - m(p) = b + sigma(p) w + white noise,        w of unit variance and correlation exp(-way / length),
so each particle has Kalman means of v, a, b and w per axis. The covariance of (v, a) depends on no reading and is one
for all particles and axes; that of (b, w) depends on the map's variance where a particle has been, and is one for all
axes. Shares and length of b, w and white noise are the map's (`ErrorStructure`): readings of a hovering drone meet one
error of the map, however many they are. No jitter is needed: velocity that is not known parts the copies.

Building frame, z up, metres, seconds, uT. `inertial_particles_plain` is the twin, one large Kalman filter a particle.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numba
import numpy as np

from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.geometry import Array
from app.tracking.constraints import ALTIMETER_VARIANCE_M2, Box, altimeter_log_likelihood
from app.tracking.field_likelihood import neutral
from app.tracking.field_lookup import FieldTable, field_table, look_up
from app.tracking.particle_filter import (
    RESAMPLE_BELOW,
    Estimate,
    effective_sample_size,
    needs_resampling,
    normalise,
    systematic_ancestors,
)  # fmt: skip

__all__ = [
    "COLUMNS", "Burst", "InertialMap", "InertialModel", "InertialParticles", "Stepped", "burst_of", "error_variances",
    "estimate_of", "inertial_map", "move", "new_particles", "step", "weigh",
]  # fmt: skip

P, V, A, B, W = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15)
_B, _W, _BB, _BW, _WW = 9, 12, 15, 16, 17
COLUMNS = 18


@dataclass(frozen=True, slots=True)
class InertialModel:
    """What is known of the device; sds, per axis.

    acceleration_m_s2         white noise of one accelerometer sample, and `bias_m_s2` of its constant bias
    position_m_per_sqrt_s     what the position wanders besides, per square root of a second
    reading_uT                white noise of one magnetometer reading, and `offset_uT` of its constant offset
    altimeter_m               of a height
    """

    acceleration_m_s2: float = 1.5
    bias_m_s2: float = 0.05
    position_m_per_sqrt_s: float = 0.014
    reading_uT: float = 0.12
    offset_uT: float = 0.25
    altimeter_m: float = ALTIMETER_VARIANCE_M2**0.5


class InertialMap(NamedTuple):
    """The field, the variance (uT^2) that errors of surveys add to the map's own, the typical sum, and structure."""

    table: FieldTable
    noise_uT2: float
    typical_uT2: float
    structure: ErrorStructure


@dataclass(frozen=True, slots=True, eq=False)
class InertialParticles:
    """rows (n, COLUMNS): position, means of v, a, b and w, variances bb, bw and ww of (b, w); of one axis as of all.

    log_weight (n,) up to a constant; inertial (2, 2): covariance of (v, a) of an axis, given a particle's path.
    """

    rows: Array
    log_weight: Array
    inertial: Array

    def __len__(self) -> int:
        return len(self.rows)


class Burst(NamedTuple):
    """Accelerometer samples between two readings: their sums, and what they are linear in, per axis.

    gained_m_s, moved_m (3,); transition (2, 2) of (v, a); lever (2,) of (v, a) to the position gained; noise (2, 2) of
    position and velocity.
    """

    gained_m_s: Array
    moved_m: Array
    transition: Array
    lever: Array
    noise: Array


class Stepped(NamedTuple):
    """particles after resampling if any; estimate before it; log evidence (nats, -inf where `diverged`)."""

    particles: InertialParticles
    estimate: Estimate
    effective: float
    log_evidence: float
    resampled: bool
    diverged: bool
    all_outside: bool


def inertial_map(grid: FieldGrid) -> InertialMap:
    """What the filter reads of a vector map."""
    noise = float(np.mean(np.square(grid.noise_sd_uT)))
    own = np.square(grid.sd_uT[grid.measured].astype(np.float64)).mean(axis=1)
    return InertialMap(field_table(grid), noise, float(np.median(own)) + noise, grid.error_structure)


def new_particles(
    position_m: Array, velocity_m_s: Array, velocity_sd_m_s: float, model: InertialModel, the_map: InertialMap
) -> InertialParticles:
    """Of one weight, at positions (n, 3), all with velocity (3,) of that sd per axis."""
    rows = np.zeros((len(position_m), COLUMNS))
    rows[:, P], rows[:, V], rows[:, _WW] = position_m, velocity_m_s, 1.0
    rows[:, _BB] = model.offset_uT**2 + the_map.structure.constant_share * the_map.typical_uT2
    inertial = np.diag([velocity_sd_m_s**2, model.bias_m_s2**2])
    return InertialParticles(rows, np.full(len(rows), -np.log(len(rows))), inertial)


def burst_of(acceleration_m_s2: Array, step_s: float, model: InertialModel) -> Burst:
    """Of samples (m, 3), gravity removed: m steps of semi-implicit Euler (Kuevor, eq. 4.6), their noise included."""
    m = len(acceleration_m_s2)
    gained = step_s * np.cumsum(acceleration_m_s2, axis=0)
    later = step_s * np.arange(m, 0, -1.0)
    kick = step_s**2 * model.acceleration_m_s2**2 * np.stack([later, np.ones(m)])
    noise = kick @ np.stack([later, np.ones(m)]).T
    noise[0, 0] += model.position_m_per_sqrt_s**2 * m * step_s
    transition, lever = np.array([[1.0, -m * step_s], [0.0, 1.0]]), np.array([m * step_s, -step_s * later.sum()])
    return Burst(gained[-1], step_s * gained.sum(axis=0), transition, lever, noise)


def move(particles: InertialParticles, burst: Burst, noise: Array) -> InertialParticles:
    """Draw positions given what is known of v and a, and learn v and a from what was drawn; noise (n, 3) normal."""
    H, F, covariance = burst.lever, burst.transition, particles.inertial
    variance = float(H @ covariance @ H) + burst.noise[0, 0]
    gain = (F @ covariance @ H + np.array([burst.noise[0, 1], 0.0])) / variance
    after = F @ covariance @ F.T - variance * np.outer(gain, gain)
    after[0, 0] += burst.noise[1, 1]
    v, a, drawn = particles.rows[:, V], particles.rows[:, A], np.sqrt(variance) * noise
    rows = particles.rows.copy()
    rows[:, P] += burst.moved_m + H[0] * v + H[1] * a + drawn
    rows[:, V] = v + burst.gained_m_s + F[0, 1] * a + gain[0] * drawn
    rows[:, A] = a + gain[1] * drawn
    return replace(particles, rows=rows, inertial=after)


def weigh(
    particles: InertialParticles, from_m: Array, reading_uT: Array, the_map: InertialMap, model: InertialModel
) -> InertialParticles:
    """Log weights and (b, w) after a reading (3,); from_m (n, 3): where the particles were at the one before.

    Where nothing is mapped a particle learns nothing, and keeps its share of the weight (`field_likelihood.neutral`).
    """
    rows, log_l = particles.rows.copy(), np.zeros(len(particles))
    looked, per_m = look_up(the_map.table, rows[:, P]), 1.0 / the_map.structure.walk_length_m
    way_m = np.sqrt(np.square(rows[:, P] - from_m).sum(axis=1))
    errors = error_variances(looked.variance_uT2.mean(axis=1), the_map, model)
    _weigh(rows, log_l, way_m, reading_uT, looked.mean_uT, *errors, looked.measured, per_m)
    log_l = neutral(log_l, looked.measured, particles.log_weight)
    return replace(particles, rows=rows, log_weight=particles.log_weight + log_l)


def error_variances(own_uT2: Array, the_map: InertialMap, model: InertialModel) -> tuple[Array, float]:
    """Variance of walk noise (n,) where the map's own is (n,), and the variance of white noise, uT^2.

    What the map does not know of a place is one error there, however long a device hovers: it is walk noise at least,
    and never white. Were white noise of the place, each reading would pay for hovering where the map is surer.
    """
    shares = the_map.structure
    walk = np.maximum(shares.walk_share * (own_uT2 + the_map.noise_uT2), own_uT2)
    return walk, shares.white_share * the_map.typical_uT2 + model.reading_uT**2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weigh(  # type: ignore[no-untyped-def]
    rows, log_l, way, reading, mean, walk, white, measured, per_m
):
    for i in range(len(rows)):
        row = rows[i]
        fade = np.exp(-way[i] * per_m)
        bb, bw, ww = row[_BB], fade * row[_BW], fade * fade * row[_WW] + 1.0 - fade * fade
        sigma = np.sqrt(walk[i])
        to_b, to_w = bb + sigma * bw, bw + sigma * ww
        total = to_b + sigma * to_w + white
        gain_b, gain_w = to_b / total, to_w / total
        if measured[i]:
            bb, bw, ww = bb - gain_b * to_b, bw - gain_b * to_w, ww - gain_w * to_w
        row[_BB], row[_BW], row[_WW] = bb, bw, ww
        squares = 0.0
        for k in range(3):
            w = fade * row[_W + k]
            off = reading[k] - mean[i, k] - row[_B + k] - sigma * w
            if measured[i]:
                row[_B + k] += gain_b * off
                w += gain_w * off
            row[_W + k] = w
            squares += off * off
        log_l[i] = -0.5 * (squares / total + 3.0 * np.log(6.283185307179586 * total))


def estimate_of(particles: InertialParticles, weight: Array) -> Estimate:
    """Mean (12,) and covariance (12, 12) of position, velocity, accelerometer bias and offset, under weights (n,)."""
    state = particles.rows[:, :12]
    mean = weight @ state
    off = state - mean
    covariance = (weight[:, None] * off).T @ off
    covariance[3:9, 3:9] += np.kron(particles.inertial, np.eye(3))
    covariance[B, B] += float(weight @ particles.rows[:, _BB]) * np.eye(3)
    return Estimate(mean, covariance)


def step(
    particles: InertialParticles, burst: Burst, reading_uT: Array, the_map: InertialMap, model: InertialModel,
    rng: np.random.Generator, *, height_m: float | None = None, box: Box | None = None,
    resample_below: float = RESAMPLE_BELOW,
) -> Stepped:  # fmt: skip
    """Move, test the box, weigh, estimate, resample if needed: 3 n normals are drawn, and one uniform to resample.

    Where all have lost, weights start again as equal: the caller decides how to find itself again.
    """
    before, from_m = normalise(particles.log_weight).log_sum, particles.rows[:, P]
    moved, all_outside = _boxed(move(particles, burst, rng.standard_normal((len(particles), 3))), box)
    found = weigh(moved, from_m, reading_uT, the_map, model)
    if height_m is not None:
        height = altimeter_log_likelihood(found.rows[:, 2], height_m, model.altimeter_m**2)
        found = replace(found, log_weight=found.log_weight + height)
    weight, log_sum, diverged = normalise(found.log_weight)
    estimate, effective = estimate_of(found, weight), effective_sample_size(weight)
    resampled = not diverged and needs_resampling(weight, resample_below)
    chosen = systematic_ancestors(weight, rng.random()) if resampled else np.arange(len(weight))
    with np.errstate(divide="ignore"):
        log_weight = np.full(len(weight), -np.log(len(weight))) if resampled else np.log(weight)
    kept = replace(found, rows=found.rows[chosen], log_weight=log_weight)
    evidence = -np.inf if diverged else log_sum - before
    return Stepped(kept, estimate, effective, evidence, resampled, diverged, all_outside)


def _boxed(particles: InertialParticles, box: Box | None) -> tuple[InertialParticles, bool]:
    if box is None:
        return particles, False
    found = box.apply(particles.rows[:, :6], particles.log_weight)
    rows = np.concatenate([found.state, particles.rows[:, 6:]], axis=1)
    return replace(particles, rows=rows, log_weight=found.log_weight), found.all_outside
