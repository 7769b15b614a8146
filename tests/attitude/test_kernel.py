"""The compiled filter against its plain twin, and its measurement against finite differences."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.attitude import layout
from app.attitude.mekf import begin, follow_attitude
from app.attitude.options import AttitudeOptions, InertialSamples, tuning_of
from app.attitude.plain_kernel import PlainFilter, cross_matrix
from app.attitude.reference import MagneticReference, constant_reference, learned_reference, map_reference


def _hard_going(tumbled, rng: np.random.Generator) -> InertialSamples:  # type: ignore[no-untyped-def]
    """Gaps in every stream and in time, a magnet put on the device, and a disturbance: every branch is taken."""
    t, gyro, force, mag = (
        each.copy()
        for each in (
            tumbled.samples.t_s,
            tumbled.samples.gyro_rad_per_s,
            tumbled.samples.accelerometer_m_per_s2,
            tumbled.samples.magnetometer_uT,
        )
    )
    t[900:] += 1.0
    mag += [19.0, -24.0, 26.0]
    mag[700:] += [10.0, -5.0, 12.0]
    mag[1300:1450] += 60.0
    for stream, share in ((gyro, 0.1), (force, 0.1), (mag, 0.5)):
        stream[rng.random(len(t)) < share] = np.nan
    force[1500:1560] = np.nan
    return InertialSamples(t, gyro, force, mag)


@pytest.mark.parametrize("translation", ["bounded", "ignored"])
@pytest.mark.parametrize("kind", ["none", "constant", "map", "learned"])
def test_the_kernel_is_its_plain_twin(tumble: Callable, translation: str, kind: str) -> None:
    tumbled, rng = tumble(seed=3, seconds=18.0), np.random.default_rng(4)
    samples, n, m = _hard_going(tumbled, rng), len(tumbled.truth), tumbled.field_uT
    reference: MagneticReference | None = {
        "none": None,
        "constant": constant_reference(m, 1.5),
        "map": map_reference(m + rng.normal(size=(n, 3)), rng.uniform(0.5, 1.5, (n, 3))),
        "learned": learned_reference(),
    }[kind]
    options = AttitudeOptions(translation=translation, recovery_s=1.0)  # type: ignore[arg-type]
    state = begin(samples, reference, options)
    end, run = follow_attitude(state, samples, reference, options)
    assert run.disturbed.any() == (kind != "none")
    twin = PlainFilter(state.q_body_to_building, state.mean, state.joint_covariance, state.kept, tuning_of(options))
    B, V = (np.zeros((1, 3)), np.zeros((1, 3, 3))) if reference is None else reference.rows(n)
    flags = np.stack([run.magnetometer_used, run.disturbed, run.accelerometer_used], axis=1)
    for i in range(n):
        q, P, bias, flag = twin.step(
            samples.t_s[i],
            samples.gyro_rad_per_s[i],
            samples.accelerometer_m_per_s2[i],
            samples.magnetometer_uT[i],
            None if kind in ("none", "learned") else B[min(i, len(B) - 1)],
            V[min(i, len(V) - 1)],
            kind == "learned",
        )
        assert abs(abs(q @ run.q_body_to_building[i]) - 1.0) < 1e-12
        assert np.allclose(P, run.covariance_rad2[i], rtol=1e-8, atol=1e-13)
        assert np.allclose(bias, run.gyro_bias_rad_per_s[i], atol=1e-11)
        assert flag == tuple(flags[i])
    assert np.allclose(twin.P, end.joint_covariance, rtol=1e-7, atol=1e-11)
    assert np.allclose(twin.x[3:], end.mean, atol=1e-8)


def test_the_magnetometers_jacobian_is_the_finite_difference() -> None:
    rng = np.random.default_rng(5)
    attitude, m, iron = Rotation.random(rng=rng), np.array([15.0, -4.0, -40.0]), np.array([3.0, -2.0, 1.0])

    def read(error: np.ndarray) -> np.ndarray:
        turned = attitude * Rotation.from_rotvec(error[:3])
        return turned.inv().apply(m + error[3:6]) + iron + error[6:]

    step = 1e-6
    slopes = np.stack([(read(step * e) - read(-step * e)) / (2 * step) for e in np.eye(9)], axis=1)
    R = attitude.as_matrix()
    assert np.allclose(slopes, np.hstack([cross_matrix(R.T @ m), R.T, np.eye(3)]), atol=1e-7)


def test_small_errors_of_a_still_body_follow_the_linear_kalman_filter() -> None:
    """Level, at rest, gravity only: a filter of two numbers per axis, which numpy can run beside it."""
    rng, n, dt = np.random.default_rng(6), 400, 0.02
    options = AttitudeOptions(
        translation="ignored", rest_detection=False, accelerometer_correlation_s=0.0, gyro_scale=0.0,
        accelerometer_gate=1e9, gyro_delay_s=0.0,
    )  # fmt: skip
    t = dt * np.arange(n)
    gyro, force = 1e-4 * rng.normal(size=(n, 3)), np.array([0.0, 0.0, 9.81]) + 1e-3 * rng.normal(size=(n, 3))
    samples = InertialSamples(t, gyro, force, np.full((n, 3), np.nan))
    state = begin(samples, None, options)
    start = state.q_body_to_building.copy()
    end, run = follow_attitude(state, samples, None, options)
    g = state.kept[layout.GRAVITY]
    F = np.array([[1.0, -dt], [0.0, 1.0]])
    v, u = options.gyro_noise_rad_per_sqrt_s**2, options.gyro_bias_walk_rad_per_s_sqrt_s**2
    Q = np.array([[v * dt + u * dt**3 / 3, -u * dt**2 / 2], [-u * dt**2 / 2, u * dt]])
    H, noise = np.array([[g, 0.0]]), options.accelerometer_m_per_s2**2
    mean, P = np.zeros(2), np.diag([state.joint_covariance[0, 0], options.gyro_bias_rad_per_s**2])
    mean[0] = 2.0 * start[1]
    for i in range(1, n):  # about x: gravity's y component is g times the angle, up to the sign of the error
        mean = np.array([mean[0] + dt * (gyro[i, 0] - mean[1]), mean[1]])
        P = F @ P @ F.T + Q
        gain = P @ H.T / (H @ P @ H.T + noise)
        mean = mean + (gain * (force[i, 1] - g * mean[0])).ravel()
        P = (np.eye(2) - gain @ H) @ P
    assert 2.0 * run.q_body_to_building[-1, 1] == pytest.approx(mean[0], abs=1e-8)
    assert run.gyro_bias_rad_per_s[-1, 0] == pytest.approx(mean[1], abs=1e-8)
    assert end.joint_covariance[0, 0] == pytest.approx(P[0, 0], rel=1e-5)
