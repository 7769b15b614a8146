"""The twin of `inertial_particles`: one Kalman filter of twelve states for each particle, written out as matrices.

State (v, a, b, w), three axes each. Slow, and shares nothing with what it checks but the layout of the rows.
"""

from dataclasses import replace

import numpy as np

from app.field.grid import FieldGrid
from app.geometry import Array
from app.tracking.field_likelihood import neutral
from app.tracking.inertial_particles import InertialMap, InertialModel, InertialParticles

__all__ = ["move_and_weigh_plain"]

_I, _O = np.eye(3), np.zeros((3, 3))


def move_and_weigh_plain(
    particles: InertialParticles, acceleration_m_s2: Array, step_s: float, noise: Array, reading_uT: Array,
    grid: FieldGrid, the_map: InertialMap, model: InertialModel,
) -> InertialParticles:  # fmt: skip
    """Rows, log weights and covariance after a burst (m, 3), normals (n, 3) and a reading (3,)."""
    rows, log_l, inertial = particles.rows.copy(), np.zeros(len(particles)), particles.inertial
    measured = np.zeros(len(particles), dtype=np.bool_)
    for i, row in enumerate(particles.rows):
        from_m, mean, covariance = row[:3], row[3:15], _covariance(row, particles.inertial)
        to_m, mean, covariance = _moved(from_m, mean, covariance, acceleration_m_s2, step_s, noise[i], model)
        inertial = covariance[np.ix_([0, 3], [0, 3])]
        fade = np.exp(-float(np.linalg.norm(to_m - from_m)) / the_map.structure.walk_length_m)
        F, Q = np.diag(np.repeat([1.0, fade], [9, 3])), np.diag(np.repeat([0.0, 1.0 - fade**2], [9, 3]))
        mean, covariance = F @ mean, F @ covariance @ F.T + Q
        after, log_l[i], measured[i] = _weighed(to_m, mean, covariance, reading_uT, grid, the_map, model)
        mean, covariance = after if measured[i] else (mean, covariance)
        rows[i] = np.concatenate([to_m, mean, covariance[[6, 6, 9], [6, 9, 9]]])
    log_weight = particles.log_weight + neutral(log_l, measured, particles.log_weight)
    return replace(particles, rows=rows, log_weight=log_weight, inertial=inertial)


def _covariance(row: Array, inertial: Array) -> Array:
    """(12, 12) of a row."""
    errors = np.array([[row[15], row[16]], [row[16], row[17]]])
    return np.block([[np.kron(inertial, _I), np.zeros((6, 6))], [np.zeros((6, 6)), np.kron(errors, _I)]])


def _moved(
    from_m: Array, mean: Array, covariance: Array, acceleration_m_s2: Array, step_s: float, noise: Array,
    model: InertialModel,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Position (3,), mean (12,) and covariance (12, 12): (p, v, a, b, w) step by step, then p is drawn."""
    joint, P = np.concatenate([from_m, mean]), np.zeros((15, 15))
    P[3:, 3:] = covariance
    F, G = np.eye(15), np.zeros((15, 3))
    F[3:6, 6:9], F[:3, 3:6], F[:3, 6:9] = -step_s * _I, step_s * _I, -(step_s**2) * _I
    G[:3], G[3:6] = step_s**2 * _I, step_s * _I
    for each in acceleration_m_s2:
        joint = F @ joint + G @ each
        P = F @ P @ F.T + model.acceleration_m_s2**2 * G @ G.T
        P[:3, :3] += model.position_m_per_sqrt_s**2 * step_s * _I
    to_m = joint[:3] + np.linalg.cholesky(P[:3, :3]) @ noise
    gain = P[3:, :3] @ np.linalg.inv(P[:3, :3])
    return to_m, joint[3:] + gain @ (to_m - joint[:3]), P[3:, 3:] - gain @ P[:3, 3:]


def _weighed(
    at_m: Array, mean: Array, covariance: Array, reading_uT: Array, grid: FieldGrid, the_map: InertialMap,
    model: InertialModel,
) -> tuple[tuple[Array, Array], float, bool]:  # fmt: skip
    """Mean and covariance after the reading, its log density, and whether the place is mapped."""
    field, shares = grid.at(at_m[None]), the_map.structure
    own = float(np.mean(np.square(field.sd_uT)))
    walk = max(shares.walk_share * (own + float(np.mean(np.square(grid.noise_sd_uT)))), own)
    H = np.hstack([_O, _O, _I, np.sqrt(walk) * _I])
    S = H @ covariance @ H.T + (shares.white_share * the_map.typical_uT2 + model.reading_uT**2) * _I
    gain, off = covariance @ H.T @ np.linalg.inv(S), reading_uT - field.mean_uT[0] - H @ mean
    log_l = -0.5 * float(off @ np.linalg.solve(S, off) + np.linalg.slogdet(2.0 * np.pi * S)[1])
    return (mean + gain @ off, covariance - gain @ H @ covariance), log_l, bool(field.measured[0])
