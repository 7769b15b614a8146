"""Motion models: each a few named parameters and `propagate`, which moves particles (n, d) and draws from `rng`.

RandomWalk      state: any; nothing is known but that it moves
Displacement    state [x, y, heading, scale]: odometry or step-and-heading, its heading and scale drifting
GaussMarkov     state [p, v, a] per axis: acceleration forgets itself after a time constant (Shockley 10.2)
Accelerometer   state [x, y, z, vx, vy, vz]: dead reckoning with a levelled accelerometer (Kuevor, eq. 4.6-4.7)

Building frame, z up, metres and seconds. Weights are untouched (Kuevor, L1537).
"""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array

__all__ = ["GRAVITY_M_S2", "Accelerometer", "Displacement", "GaussMarkov", "RandomWalk", "without_gravity"]

GRAVITY_M_S2 = 9.81
_CANCELS_BELOW = 0.1  # of T / tau: there the closed form of the noise loses digits
_NODE, _NODE_WEIGHT = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True, slots=True)
class RandomWalk:
    """Independent Gaussian steps of every column; sd per square root of a second."""

    sd_m_per_sqrt_s: float = 1.0

    def propagate(self, state: Array, elapsed_s: float, rng: np.random.Generator) -> Array:
        return np.asarray(state + self.sd_m_per_sqrt_s * np.sqrt(elapsed_s) * rng.standard_normal(state.shape))


@dataclass(frozen=True, slots=True)
class Displacement:
    """Steps told in a frame whose yaw and scale drift: p += scale Rz(heading) d + noise, per particle.

    State [x, y, heading, scale]: heading turns the teller's frame into the building's, scale is true over told length.
    All sds grow with the square root of the distance told, and heading's also with that of time (gyroscope).
    """

    position_sd_m_per_sqrt_m: float = 0.1
    heading_sd_rad_per_sqrt_m: float = 0.02
    scale_sd_per_sqrt_m: float = 0.005
    heading_sd_rad_per_sqrt_s: float = 0.0

    def sds(self, length_m: float, elapsed_s: float = 0.0) -> tuple[float, float, float]:
        """Sds of the position (per axis), heading and scale steps over a displacement."""
        root_m = float(np.sqrt(length_m))
        heading = np.hypot(self.heading_sd_rad_per_sqrt_m * root_m, self.heading_sd_rad_per_sqrt_s * elapsed_s**0.5)
        return self.position_sd_m_per_sqrt_m * root_m, float(heading), self.scale_sd_per_sqrt_m * root_m

    def propagate(self, state: Array, displacement_m: Array, rng: np.random.Generator, elapsed_s: float = 0.0) -> Array:
        """States (n, 4) after a displacement (2,) in the teller's level frame; heading and scale change first."""
        position_sd, heading_sd, scale_sd = self.sds(float(np.hypot(*displacement_m)), elapsed_s)
        noise = rng.standard_normal(state.shape)
        heading, scale = state[:, 2] + heading_sd * noise[:, 2], state[:, 3] + scale_sd * noise[:, 3]
        c, s = scale * np.cos(heading), scale * np.sin(heading)
        dx, dy = displacement_m
        x = state[:, 0] + c * dx - s * dy + position_sd * noise[:, 0]
        y = state[:, 1] + s * dx + c * dy + position_sd * noise[:, 1]
        return np.stack([x, y, heading, scale], axis=1)


@dataclass(frozen=True, slots=True)
class GaussMarkov:
    """First-order Gauss-Markov acceleration on each axis (Shockley, L1349); defaults are his, for road vehicles.

    State [p..., v..., a...] (n, 3 k) of k axes. `acceleration_sd_m_s2` is the steady state's. Velocity is an unbounded
    random walk: `speed_limit_m_s`, where given, shortens it (Shockley 10.2; needed for people).
    """

    time_constant_s: float = 2.0
    acceleration_sd_m_s2: float = 5.0
    speed_limit_m_s: float | None = None

    def transition(self, elapsed_s: float) -> Array:
        """(3, 3) of one axis."""
        tau = self.time_constant_s
        e1 = float(np.expm1(-elapsed_s / tau))
        slip = float(_response(elapsed_s, tau)[0])
        return np.array([[1.0, elapsed_s, slip], [0.0, 1.0, -e1 * tau], [0.0, 0.0, 1.0 + e1]])

    def noise_covariance(self, elapsed_s: float) -> Array:
        """(3, 3) of one axis: closed form, and for steps short against the time constant an integral.

        Q = q int g g' ds, g the response of [p, v, a] to a kick and q = 2 sd^2 / tau. The closed form cancels to
        nothing as T^5 for T -> 0 (Shockley 10.2); there eight Gauss-Legendre nodes are exact to rounding.
        """
        if elapsed_s < _CANCELS_BELOW * self.time_constant_s:
            return self._integrated(elapsed_s)
        a, T, variance = 1.0 / self.time_constant_s, elapsed_s, self.acceleration_sd_m_s2**2
        x, e = T * a, float(np.exp(-T * a))
        q11 = (1.0 - e**2 + 2.0 * x + x**3 * 2.0 / 3.0 - 2.0 * x**2 - 4.0 * x * e) / a**4
        q12 = (e**2 + 1.0 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2) / a**3
        q13 = (1.0 - e**2 - 2.0 * x * e) / a**2
        q22 = (4.0 * e - 3.0 - e**2 + 2.0 * x) / a**2
        q23 = (e**2 + 1.0 - 2.0 * e) / a
        return variance * np.array([[q11, q12, q13], [q12, q22, q23], [q13, q23, 1.0 - e**2]])

    def propagate(self, state: Array, elapsed_s: float, rng: np.random.Generator) -> Array:
        """States (n, 3 k) after `elapsed_s`, the true time however long; none passes without noise."""
        if elapsed_s <= 0.0:
            return state
        axes = state.shape[1] // 3
        moved = state @ np.kron(self.transition(elapsed_s), np.eye(axes)).T
        root = np.linalg.cholesky(self.noise_covariance(elapsed_s))
        moved += rng.standard_normal(state.shape) @ np.kron(root, np.eye(axes)).T
        if self.speed_limit_m_s is not None:
            velocity = moved[:, axes : 2 * axes]
            speed = np.linalg.norm(velocity, axis=1, keepdims=True)
            velocity *= np.minimum(1.0, self.speed_limit_m_s / np.maximum(speed, 1e-12))
        return moved

    def _integrated(self, elapsed_s: float) -> Array:
        g = _response(0.5 * elapsed_s * (_NODE + 1.0), self.time_constant_s)
        strength = 2.0 * self.acceleration_sd_m_s2**2 / self.time_constant_s
        return np.asarray(strength * 0.5 * elapsed_s * (_NODE_WEIGHT * g) @ g.T)


@dataclass(frozen=True, slots=True)
class Accelerometer:
    """Semi-implicit Euler: v += a dt, then p += v dt with the *new* v, then noise on both (Kuevor, L1528-L1537).

    Sds are of one nominal step and grow with the square root of time. The source gives no values; these are the
    starting values of a trial of ours. No bias state: noise must cover it.
    """

    position_sd_m: float = 0.001
    velocity_sd_m_s: float = 0.03
    nominal_step_s: float = 0.005

    def propagate(self, state: Array, acceleration_m_s2: Array, elapsed_s: float, rng: np.random.Generator) -> Array:
        """States (n, 6) after one step with acceleration (3,), gravity removed, z up."""
        return self.propagate_burst(state, np.reshape(acceleration_m_s2, (1, 3)), elapsed_s, rng)

    def propagate_burst(self, state: Array, acceleration_m_s2: Array, step_s: float, rng: np.random.Generator) -> Array:
        """States (n, 6) after m steps of `step_s` with accelerations (m, 3), all at once.

        The steps are linear and their noise Gaussian, so their sum is drawn exactly: position and velocity noise per
        axis have the covariance of m steps. What is between them (box, weights) is not seen.
        """
        gained = np.cumsum(acceleration_m_s2, axis=0) * step_s
        m = len(gained)
        moved = state.copy()
        moved[:, 3:] += gained[-1]
        moved[:, :3] += m * step_s * state[:, 3:] + gained.sum(axis=0) * step_s
        noise = rng.standard_normal((2, len(state), 3))
        root = np.linalg.cholesky(self.noise_covariance(m, step_s))
        moved[:, :3] += root[0, 0] * noise[0]
        moved[:, 3:] += root[1, 0] * noise[0] + root[1, 1] * noise[1]
        return moved

    def noise_covariance(self, steps: int, step_s: float) -> Array:
        """(2, 2) of position and velocity of one axis after so many steps from nothing.

        Noise is added after each step (literally as printed), so a step's own velocity noise moves the position from
        the next step on: k steps later by k dt.
        """
        share = step_s / self.nominal_step_s
        qp, qv = self.position_sd_m**2 * share, self.velocity_sd_m_s**2 * share
        later = step_s * np.arange(steps)
        return np.array([[steps * qp + qv * np.sum(later**2), qv * np.sum(later)], [qv * np.sum(later), steps * qv]])


def without_gravity(specific_force_m_s2: Array) -> Array:
    """Acceleration of a specific force (..., 3) already rotated to the building frame, z up: at rest [0, 0, +g] -> 0.

    The source does not mention it; without it everything falls upwards (Kuevor, L1528; our reconstruction).
    """
    return np.asarray(specific_force_m_s2 - np.array([0.0, 0.0, GRAVITY_M_S2]))


def _response(elapsed_s: Array | float, time_constant_s: float) -> Array:
    """(3, ...) what a unit acceleration now makes of position, velocity and acceleration later."""
    x = np.asarray(elapsed_s) / time_constant_s
    series = x**2 * (0.5 - x * (1.0 / 6.0 - x * (1.0 / 24.0 - x * (1.0 / 120.0 - x / 720.0))))
    slip = np.where(x < 0.01, series, np.expm1(-x) + x)
    return np.stack([time_constant_s**2 * slip, -time_constant_s * np.expm1(-x), np.exp(-x)])
