"""The linear Kalman filter as small functions, and a vehicle of constant velocity on a floor (Storms 1.5-1.8).

The state of that model is `[x, y, vx, vy]` in the building frame, m and m/s; the source keeps (Y, X) with z down. A
belief goes in, a belief comes out: nothing is changed in place.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
from scipy.linalg import expm

from app.geometry import Array

__all__ = [
    "POSITION", "DiscreteModel", "GaussianBelief", "Update", "condition_on_position", "constant_velocity", "predict",
    "rotate_velocity", "smooth", "update", "van_loan",
    "velocity_rotation",
]  # fmt: skip

POSITION = np.eye(2, 4)
"""H of a position measurement of the constant-velocity state (Storms, L583)."""


@dataclass(frozen=True, slots=True, eq=False)
class GaussianBelief:
    """What is believed of a state: `mean` (n,) and `covariance` (n, n)."""

    mean: Array
    covariance: Array

    @property
    def position_m(self) -> Array:
        """(2,) the first two entries."""
        return self.mean[:2]

    @property
    def position_covariance_m2(self) -> Array:
        """(2, 2) their covariance."""
        return self.covariance[:2, :2]


@dataclass(frozen=True, slots=True, eq=False)
class DiscreteModel:
    """One step: transition (n, n), control (n, m), process_noise (n, n) (Storms, L316-331, eqs. 2.3-2.6)."""

    transition: Array
    control: Array
    process_noise: Array


class Update(NamedTuple):
    """The belief after a measurement; innovation (k,), its covariance (k, k) and the gain (n, k) that made it."""

    belief: GaussianBelief
    innovation: Array
    innovation_covariance: Array
    gain: Array

    @property
    def squared_distance(self) -> float:
        """Innovation over its covariance: chi-square with k degrees of freedom under a correct model."""
        return float(self.innovation @ np.linalg.solve(self.innovation_covariance, self.innovation))


@lru_cache(maxsize=256)
def constant_velocity(dt_s: float, acceleration_psd_m2_s3: float) -> DiscreteModel:
    """The closed form for `[x, y, vx, vy]` driven by white acceleration (Storms, L542-546, eqs. 3.3, 3.4).

    The control is an acceleration (2,), m/s^2, held over the step. `acceleration_psd_m2_s3` is the source's sigma_a^2:
    a spectral density, though printed as an acceleration.
    """
    eye, zero = np.eye(2), np.zeros((2, 2))
    q = acceleration_psd_m2_s3
    model = DiscreteModel(
        transition=np.block([[eye, dt_s * eye], [zero, eye]]),
        control=np.vstack([0.5 * dt_s**2 * eye, dt_s * eye]),
        process_noise=np.asarray(q * np.kron([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]], eye)),
    )
    for each in (model.transition, model.control, model.process_noise):
        each.setflags(write=False)  # callers share it
    return model


def van_loan(F: Array, B: Array, G: Array, Q: Array, dt_s: float) -> DiscreteModel:
    """Discretise dx/dt = F x + B u + G w, E[w w^T] = Q delta, u held: matrix exponentials (Storms, L316-331).

    F (n, n), B (n, m), G (n, p), Q (p, p).
    """
    n, m = B.shape
    noise = expm(dt_s * np.block([[-F, G @ Q @ G.T], [np.zeros((n, n)), F.T]]))
    held = expm(dt_s * np.block([[F, B], [np.zeros((m, n + m))]]))
    transition = noise[n:, n:].T
    process_noise = transition @ noise[:n, n:]
    return DiscreteModel(transition, held[:n, n:], 0.5 * (process_noise + process_noise.T))


def predict(belief: GaussianBelief, model: DiscreteModel, control: Array | None = None) -> GaussianBelief:
    """One step of the model, with a control (m,) or none (Storms, L316-331)."""
    mean = model.transition @ belief.mean
    if control is not None:
        mean = mean + model.control @ control
    return GaussianBelief(mean, model.transition @ belief.covariance @ model.transition.T + model.process_noise)


def velocity_rotation(turn_rad: float) -> Array:
    """(4, 4) that turns the velocity of `[x, y, vx, vy]` counter-clockwise and leaves the position."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    turned = np.eye(4)
    turned[2:, 2:] = [[c, -s], [s, c]]
    return turned


def rotate_velocity(belief: GaussianBelief, turn_rad: float) -> GaussianBelief:
    """The vehicle turned by that much, counter-clockwise.

    How the source encodes a turn command is not stated (Storms, L720); this is exact whatever the speed.
    """
    turned = velocity_rotation(turn_rad)
    return GaussianBelief(turned @ belief.mean, turned @ belief.covariance @ turned.T)


def update(
    belief: GaussianBelief, measured: Array, H: Array, R: Array, form: Literal["joseph", "plain"] = "joseph"
) -> Update:
    """Fuse a measurement (k,) = H (k, n) state + noise of covariance R (k, k) (Storms, L339-343, eqs. 2.8-2.10).

    The plain form is the source's, P - K H P; Joseph's is the same number, and stays positive when rounded.
    """
    P = belief.covariance
    S = H @ P @ H.T + R
    gain = np.asarray(np.linalg.solve(S, H @ P).T, dtype=np.float64)
    innovation = measured - H @ belief.mean
    left = np.eye(len(P)) - gain @ H
    covariance = left @ P @ left.T + gain @ R @ gain.T if form == "joseph" else left @ P
    return Update(GaussianBelief(belief.mean + gain @ innovation, covariance), innovation, S, gain)


def condition_on_position(belief: GaussianBelief, position_m: Array, covariance_m2: Array) -> GaussianBelief:
    """The belief whose position has these moments (2,), (2, 2), and whose rest follows from the position as before.

    For a posterior of the position found otherwise, on a grid say, which holds the prior already.
    """
    prior = belief.position_covariance_m2
    gain = np.linalg.solve(prior, belief.covariance[:2]).T
    mean = belief.mean + gain @ (position_m - belief.position_m)
    return GaussianBelief(mean, belief.covariance + gain @ (covariance_m2 - prior) @ gain.T)


def smooth(
    filtered: Sequence[GaussianBelief], predicted: Sequence[GaussianBelief], transitions: Sequence[Array]
) -> list[GaussianBelief]:
    """Rauch-Tung-Striebel: every belief with what was measured after it too.

    `predicted[k]` and `transitions[k]` lead from `filtered[k]` to `filtered[k + 1]`; there is one fewer of them.
    """
    out = [filtered[-1]]
    for now, ahead, transition in zip(filtered[-2::-1], predicted[::-1], transitions[::-1], strict=True):
        gain = np.linalg.solve(ahead.covariance, transition @ now.covariance).T
        later = out[-1]
        mean = now.mean + gain @ (later.mean - ahead.mean)
        out.append(GaussianBelief(mean, now.covariance + gain @ (later.covariance - ahead.covariance) @ gain.T))
    return out[::-1]
