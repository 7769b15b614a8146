"""The twin of `kernel`, in plain matrices: the transition by the matrix exponential, Joseph's form as it is printed.

Slow, and short enough to be read beside the equations (Kuevor, B20; Brommer, 1.4-1.8). A test holds the two equal.
"""

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from app.attitude import layout as K
from app.attitude.options import Tuning
from app.geometry import Array

__all__ = ["PlainFilter", "cross_matrix"]

TH, BI, VE, FI, IR = (slice(i, i + 3) for i in (K.ANGLE, K.BIAS, K.VELOCITY, K.FIELD, K.IRON))
UP = np.array([0.0, 0.0, 1.0])


def cross_matrix(v: Array) -> Array:
    """(3, 3) [v x]."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class PlainFilter:
    """One filter: `step` reads a sample and returns (q, covariance (3, 3), bias, flags) as a row of `kernel.run`."""

    def __init__(self, q: Array, mean: Array, covariance: Array, kept: Array, tuning: Tuning) -> None:
        """From the arrays of an `AttitudeState`, copied."""
        self.attitude = Rotation.from_quat(q, scalar_first=True)
        self.x = np.concatenate([np.zeros(3), mean])  # indexed as the covariance is; the first three stay zero
        self.P, self.k, self.s = covariance.copy(), kept.copy(), tuning

    @property
    def R(self) -> Array:
        """(3, 3) body to building."""
        return np.asarray(self.attitude.as_matrix())

    def step(
        self, t: float, gyro: Array, force: Array, mag: Array, m: Array | None, V: Array, learned: bool
    ) -> tuple[Array, Array, Array, tuple[bool, bool, bool]]:
        """One sample at time t; m (3,) and V (3, 3) the reference there, m None for none."""
        k, s = self.k, self.s
        has_gyro, has_force, has_mag = (bool(np.all(np.isfinite(each))) for each in (gyro, force, mag))
        used, disturbed, pulled = False, False, False
        if np.isfinite(k[K.T]) and t > k[K.T]:
            rate = (gyro if has_gyro else k[K.LAST_GYRO : K.LAST_GYRO + 3]) - self.x[BI]
            last = k[K.LAST_FORCE : K.LAST_FORCE + 3]
            fresh = has_force or t - k[K.T_FORCE] < s.gyro_gap
            self._predict(t - k[K.T], rate, 0.5 * (last + (force if has_force else last)), fresh)
        k[K.T] = t
        if has_force:
            known = np.isfinite(k[K.T_FORCE])
            dt = t - k[K.T_FORCE] if known else 0.0
            _smooth(k, K.MEAN_FORCE, force, np.exp(-dt / K.REST_MEAN_S) if known else 0.0)
            k[K.LAST_FORCE : K.LAST_FORCE + 3], k[K.T_FORCE] = force, t
            pulled = dt > 0.0 and self._accelerometer(force, dt)
        if has_gyro:
            dt = t - k[K.T_GYRO] if np.isfinite(k[K.T_GYRO]) else 0.0
            k[K.LAST_GYRO : K.LAST_GYRO + 3], k[K.T_GYRO] = gyro, t
            if s.rest and dt > 0.0 and np.isfinite(k[K.T_FORCE]):
                self._rest(gyro, dt)
        if has_mag and (learned or (m is not None and bool(np.all(np.isfinite(m))))):
            dt = t - k[K.T_MAG] if np.isfinite(k[K.T_MAG]) else 0.0
            k[K.T_MAG] = t
            if dt > 0.0:
                used = self._magnetometer(mag, None if learned else m, V, dt)
                disturbed = bool(k[K.DISTURBANCE] > s.disturbed**2 or not used)
        return *self._shown(learned), self.x[BI].copy(), (used, disturbed, pulled)

    def _predict(self, dt: float, rate: Array, force: Array, fresh: bool) -> None:
        s, k = self.s, self.k
        A = np.zeros((6, 6))
        A[:3, :3], A[:3, 3:] = -cross_matrix(rate), -np.eye(3)
        F = np.eye(K.SIZE)
        F[:6, :6] = expm(A * dt)
        half = Rotation.from_rotvec(0.5 * dt * rate)
        R = (self.attitude * half).as_matrix()
        if s.bounded and fresh:
            F[VE, TH] = -dt * R @ cross_matrix(force)
            self.x[VE] += dt * (R @ force - k[K.GRAVITY] * UP)
        self.attitude = self.attitude * half * half
        turned = (s.unknown_rate * max(0.0, dt - s.gyro_gap)) ** 2
        wrong = s.gyro_scale**2 * (rate @ rate) * dt + turned
        if turned > K.LOST_RAD2:
            k[K.FORCE_REJECTED_S], k[K.NORTH_SET] = -1.0, 0.0
            k[K.NORTH], k[K.DECLINATION], k[K.DECLINATION_RAD2] = np.nan, 0.0, 0.0
        v, u, eye = s.gyro_noise**2, s.bias_walk**2, np.eye(3)
        Q = np.zeros((K.SIZE, K.SIZE))
        Q[TH, TH] = (v * dt + u * dt**3 / 3.0 + wrong) * eye
        Q[TH, BI] = Q[BI, TH] = -u * dt**2 / 2.0 * eye
        Q[BI, BI] = u * dt * eye
        Q[VE, VE] = s.force_noise**2 * dt * s.bounded * eye
        Q[FI, FI] = s.field_walk**2 * dt * k[K.NORTH_SET] * eye
        Q[IR, IR] = s.hard_iron_walk**2 * dt * eye
        self.P = F @ self.P @ F.T + Q
        if s.bounded and (not fresh or dt > s.gyro_gap):
            self._set_block(VE, np.zeros(3), s.speed**2)

    def _set_block(self, block: slice, mean: Array, variance: float) -> None:
        self.P[block, :] = 0.0
        self.P[:, block] = 0.0
        self.P[block, block] = variance * np.eye(3)
        self.x[block] = mean

    def _update(self, H: Array, r: Array, noise: Array, only: Callable[[Array], Array] = lambda gain: gain) -> None:
        gain = only(np.asarray(np.linalg.solve(H @ self.P @ H.T + noise, H @ self.P).T, dtype=np.float64))
        left = np.eye(K.SIZE) - gain @ H
        self.P = left @ self.P @ left.T + gain @ noise @ gain.T
        dx = gain @ r
        self.attitude = self.attitude * Rotation.from_rotvec(dx[TH])
        self.x[BI.start :] += dx[BI.start :]

    def _accelerometer(self, force: Array, dt: float) -> bool:
        s, k, H, eye = self.s, self.k, np.zeros((3, K.SIZE)), np.eye(3)
        if k[K.FORCE_REJECTED_S] < 0.0:
            self._relevel()
            return True
        if s.bounded:
            still = s.rest and k[K.STILL_S] > s.rest_after
            sd, correlation = (K.REST_SPEED_M_S, K.REST_MEAN_S) if still else (s.speed, s.speed_correlation)
            H[:, VE], r = eye, -self.x[VE]
        else:
            sd, correlation = s.gravity_sd, s.gravity_correlation
            predicted = k[K.GRAVITY] * self.R.T @ UP
            H[:, TH], r = cross_matrix(predicted), force - predicted
        S = H @ self.P @ H.T + sd**2 * eye
        if r @ np.linalg.solve(S, r) < s.accelerometer_gate:
            k[K.FORCE_REJECTED_S] = 0.0
            self._update(H, r, sd**2 * max(1.0, 2.0 * correlation / dt) * eye)
            return True
        k[K.FORCE_REJECTED_S] += dt
        if k[K.FORCE_REJECTED_S] > s.recovery:
            self._relevel()
        return False

    def _relevel(self) -> None:
        self.k[K.FORCE_REJECTED_S] = 0.0
        self._level(self.k[K.MEAN_FORCE : K.MEAN_FORCE + 3])
        self._set_block(VE, np.zeros(3), self.s.speed**2 if self.s.bounded else 0.0)

    def _level(self, force: Array) -> None:
        up = self.R @ force / np.linalg.norm(force)
        axis = np.cross(up, UP)
        size = np.linalg.norm(axis)
        turn = axis / size * np.arctan2(size, up[2]) if size > 1e-12 else np.array([np.pi * (up[2] < 0), 0.0, 0.0])
        yaw = float(self.R[2] @ self.P[TH, TH] @ self.R[2]) * self.k[K.NORTH_SET]
        self.attitude = Rotation.from_rotvec(turn) * self.attitude
        self._set_block(TH, np.zeros(3), 0.0)
        self.k[K.SUM_WEIGHT : K.SUM_END] = 0.0
        self.P[TH, TH] = self.R.T @ np.diag([K.RELEVELLED_RAD**2, K.RELEVELLED_RAD**2, yaw]) @ self.R

    def _rest(self, gyro: Array, dt: float) -> None:
        s, k = self.s, self.k
        fade = np.exp(-dt / K.REST_MEAN_S) if k[K.STILL_S] >= 0.0 else 0.0
        _smooth(k, K.MEAN_GYRO, gyro, fade)
        mean = k[K.MEAN_GYRO : K.MEAN_GYRO + 3]
        turned, moved = gyro - mean, k[K.LAST_FORCE : K.LAST_FORCE + 3] - k[K.MEAN_FORCE : K.MEAN_FORCE + 3]
        still = turned @ turned < s.rest_gyro**2 and moved @ moved < s.rest_force**2
        still = still and np.abs(mean).max() < s.rest_bias
        k[K.STILL_S] = max(k[K.STILL_S], 0.0) + dt if still else 0.0
        if k[K.STILL_S] > s.rest_after:
            H = np.zeros((3, K.SIZE))
            H[:, BI] = np.eye(3)
            variance = s.gyro_noise**2 / dt + s.rest_rate**2 * max(1.0, 2.0 * K.REST_CORRELATION_S / dt)
            self._update(H, gyro - self.x[BI], variance * np.eye(3))

    def _magnetometer(self, z: Array, reference: Array | None, V: Array, dt: float) -> bool:
        s, k, learned = self.s, self.k, reference is None
        if s.learn_hard_iron:
            self._blame_device(z, learned, dt)
        if k[K.NORTH_SET] < 1.0:
            self._set_north(z, reference, V, dt)
            return True
        m, R, eye = self.x[FI] if reference is None else reference, self.R, np.eye(3)
        H = np.zeros((3, K.SIZE))
        H[:, TH], H[:, IR] = cross_matrix(R.T @ m), eye
        if learned:
            H[:, FI] = R.T
        from_map = R.T @ V @ R
        S = H @ self.P @ H.T + from_map
        self._disturbance(R @ (z - self.x[IR]), m, R @ S @ R.T, dt)
        slow = s.field**2 + k[K.DISTURBANCE] * s.weigh_disturbances
        rate = k[K.LAST_GYRO : K.LAST_GYRO + 3] - self.x[BI]
        white = s.reading**2 + s.delay**2 * float(rate @ rate) * float(m @ m)
        r = z - R.T @ m - self.x[IR]
        if r @ np.linalg.solve(S + (white + s.field**2) * eye, r) >= s.magnetometer_gate:
            patience = s.recovery / s.new_field if learned else 0.0
            k[K.MAG_REJECTED_S] += dt * (patience if k[K.DISTURBANCE] > s.disturbed**2 else 1.0)
            if k[K.MAG_REJECTED_S] > s.recovery:
                k[K.MAG_REJECTED_S] = k[K.NORTH_SET] = 0.0
                if learned:
                    self._keep_north()
            return False
        k[K.MAG_REJECTED_S] = 0.0
        more = max(1.0, 2.0 * s.field_correlation / dt)
        noise = more * from_map + (white + more * slow) * eye
        self._update(H, r, noise, self._upright if learned else lambda gain: gain)
        return True

    def _upright(self, gain: Array) -> Array:
        along = np.outer(self.R[2], self.R[2])
        gain[TH], gain[BI], gain[VE] = along @ gain[TH], along @ gain[BI], 0.0
        return gain

    def _disturbance(self, level: Array, m: Array, S: Array, dt: float) -> None:
        k, s = self.k, self.s
        _smooth(k, K.MEAN_RESIDUAL, level, np.exp(-dt / K.RESIDUAL_MEAN_S))
        b = k[K.MEAN_RESIDUAL : K.MEAN_RESIDUAL + 3]
        along = np.array([m[0], m[1], 0.0]) / max(np.hypot(m[0], m[1]), 1e-9)
        off = np.array([b[2] - m[2], np.hypot(b[0], b[1]) - np.hypot(m[0], m[1])])
        beyond = off**2 - np.array([S[2, 2], along @ S @ along]) - s.field**2
        k[K.DISTURBANCE] = max(0.5 * np.maximum(0.0, beyond).sum(), np.exp(-dt / s.memory) * k[K.DISTURBANCE])

    def _blame_device(self, z: Array, learned: bool, dt: float) -> None:
        k, s, R, fade = self.k, self.s, self.R, np.exp(-dt / K.BLAME_S)
        for start, new in (
            (K.SUM_WEIGHT, [1.0]), (K.SUM_POWER, [z @ z]), (K.SUM_FIELD, R @ z), (K.SUM_IRON, z), (K.SUM_R, R.ravel()),
        ):  # fmt: skip
            new = np.asarray(new)
            k[start : start + len(new)] = fade * k[start : start + len(new)] + new
        n = k[K.SUM_WEIGHT]
        b, c = k[K.SUM_FIELD : K.SUM_FIELD + 3] / n, k[K.SUM_IRON : K.SUM_IRON + 3] / n
        G = k[K.SUM_R : K.SUM_R + 9].reshape(3, 3) / n
        information, right = np.eye(3) - G.T @ G, c - G.T @ b
        iron = np.linalg.solve(information + K.LEAST_SPREAD * np.eye(3), right)
        now, whole = self.x[IR].copy(), k[K.SUM_POWER] / n - b @ b - 3.0 * s.reading**2
        scatter, left = (whole - 2.0 * h @ right + h @ information @ h for h in (now, iron))
        spread = 1.0 - np.sum(G * G) / 3.0
        k[K.MENDING_S] = max(0.0, k[K.MENDING_S] - dt)
        if spread < K.BLAME_SPREAD:
            return
        blamed = scatter > K.BLAME_UT**2 and scatter - left > K.BLAME_SHARE * scatter
        if blamed and np.mean((iron - now) ** 2) > K.BLAMED_UT**2:
            self._set_block(IR, iron, K.BLAMED_UT**2)
            k[K.DISTURBANCE] *= max(0.0, left / scatter)
            k[K.MENDING_S] = K.MEND_S
        field = b - G @ iron
        doubted = learned and k[K.MENDING_S] > 0.0 and left < 3.0 * K.BLAMED_UT**2
        if doubted and min(np.mean((field - self.x[FI]) ** 2), np.mean(iron**2)) > K.BLAME_UT**2:
            k[K.MENDING_S] = 0.0
            self._set_block(IR, iron, K.BLAMED_UT**2)
            self._set_block(FI, field, K.BLAMED_UT**2)

    def _keep_north(self) -> None:
        (mx, my, _), k, g = self.x[FI], self.k, np.zeros(K.SIZE)
        k[K.NORTH] = np.arctan2(my, mx) - k[K.DECLINATION]
        g[TH], g[K.FIELD], g[K.FIELD + 1] = self.R[2], my / (mx * mx + my * my), -mx / (mx * mx + my * my)
        k[K.DECLINATION_RAD2] += g @ self.P @ g

    def _set_north(self, z: Array, reference: Array | None, V: Array, dt: float) -> None:
        k, s, R = self.k, self.s, self.R
        _smooth(k, K.MEAN_RESIDUAL, R @ z, 1.0 - min(1.0, dt / (k[K.NORTH_SET] * K.NORTH_SET_S + dt)))
        k[K.NORTH_SET] = min(1.0, k[K.NORTH_SET] + dt / K.NORTH_SET_S)
        k[K.DISTURBANCE] = 0.0
        mean = R.T @ k[K.MEAN_RESIDUAL : K.MEAN_RESIDUAL + 3]
        variance = s.reading**2 + s.field**2
        if reference is None:
            J = np.zeros((3, K.SIZE))
            J[:, TH], J[:, IR] = -R @ cross_matrix(mean - self.x[IR]), -R
            iron = self.x[IR].copy()
            self._set_block(FI, R @ (mean - iron), 0.0)
            self.P[FI, :] = J @ self.P
            self.P[:, FI] = self.P[FI, :].T
            self.P[FI, FI] = J @ self.P @ J.T + variance * np.eye(3)
            if np.isfinite(k[K.NORTH]):
                k[K.DECLINATION] = np.arctan2(self.x[K.FIELD + 1], self.x[K.FIELD]) - k[K.NORTH]
        elif k[K.NORTH_SET] == 1.0:
            self._set_yaw(mean - self.x[IR], reference, variance + float(np.trace(V)) / 3.0)
            k[K.MEAN_RESIDUAL : K.MEAN_RESIDUAL + 3] = reference

    def _set_yaw(self, reading: Array, m: Array, variance: float) -> None:
        b = self.R @ reading
        yaw = np.arctan2(m[1], m[0]) - np.arctan2(b[1], b[0])
        self.attitude = Rotation.from_rotvec(np.arctan2(np.sin(yaw), np.cos(yaw)) * UP) * self.attitude
        R, level = self.R, max(float(np.hypot(m[0], m[1])), 1e-6)
        along, across = np.array([m[0], m[1], 0.0]) / level, np.array([-m[1], m[0], 0.0]) / level
        T = np.eye(K.SIZE)
        T[TH, TH] = np.eye(3) - np.outer(R[2], R[2])
        T[TH, TH] += np.outer(R[2], R.T @ along) * m[2] / level
        T[TH, IR] = np.outer(R[2], R.T @ across) / level
        more = variance / level**2
        if R[2] @ (T @ self.P @ T.T)[TH, TH] @ R[2] + more > K.UNKNOWN_YAW_RAD2:
            self.k[K.NORTH_SET] = 0.0
            return
        self.P = T @ self.P @ T.T
        self.P[TH, TH] += more * np.outer(R[2], R[2])
        self.k[K.SUM_WEIGHT : K.SUM_END] = 0.0

    def _shown(self, learned: bool) -> tuple[Array, Array]:
        rate = self.k[K.LAST_GYRO : K.LAST_GYRO + 3] - self.x[BI]
        shown, J = self.attitude * Rotation.from_rotvec(self.s.gyro_delay * rate), np.eye(3, K.SIZE)
        if learned and (self.k[K.NORTH_SET] > 0.0 or np.isfinite(self.k[K.NORTH])):
            mx, my, _ = self.x[FI]
            R2 = shown.as_matrix()[2]
            shown = Rotation.from_rotvec((self.k[K.DECLINATION] - np.arctan2(my, mx)) * UP) * shown
            J[:, K.FIELD], J[:, K.FIELD + 1] = R2 * my / (mx * mx + my * my), -R2 * mx / (mx * mx + my * my)
        up = shown.as_matrix()[2]
        lost = self.k[K.NORTH_SET] < 1.0 and not np.isfinite(self.k[K.NORTH])
        more = K.UNKNOWN_YAW_RAD2 if lost else self.k[K.DECLINATION_RAD2]
        return np.asarray(shown.as_quat(scalar_first=True)), J @ self.P @ J.T + more * np.outer(up, up)


def _smooth(k: Array, start: int, new: Array, fade: float) -> None:
    k[start : start + 3] = fade * k[start : start + 3] + (1.0 - fade) * new
