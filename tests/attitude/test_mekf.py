"""The filter on a body that tumbles: accuracy, honesty, recovery, and any cut into chunks."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.attitude import layout
from app.attitude.mekf import AttitudeRun, AttitudeState, begin, follow_attitude
from app.attitude.options import AttitudeOptions, InertialSamples
from app.attitude.reference import MagneticReference, constant_reference, learned_reference, level_reference
from app.errors import InvalidInput
from app.synthetic.imu import ImuNoise

PLAIN = AttitudeOptions(gyro_delay_s=0.0)
WHITE = replace(PLAIN, field_uT=0.3, field_correlation_s=0.0, magnetometer_delay_s=0.0, hard_iron_uT=0.0,
                hard_iron_walk_uT_per_sqrt_s=0.0)  # fmt: skip


def _cut(samples: InertialSamples, a: int, b: int) -> InertialSamples:
    return InertialSamples(
        samples.t_s[a:b],
        samples.gyro_rad_per_s[a:b],
        samples.accelerometer_m_per_s2[a:b],
        samples.magnetometer_uT[a:b],
    )


def _deg(error_rad: np.ndarray) -> float:
    return float(np.rad2deg(np.sqrt(np.square(error_rad).sum(axis=1).mean())))


def test_attitude_is_found_with_a_known_field(tumble: Callable) -> None:
    tumbled = tumble()
    reference = constant_reference(tumbled.field_uT)
    _, run = follow_attitude(begin(tumbled.samples, reference, WHITE), tumbled.samples, reference, WHITE)
    assert _deg(tumbled.error_rad(run.q_body_to_building)[500:]) < 0.5
    assert run.magnetometer_used[1:].all()
    assert not run.disturbed.any()


def test_a_learned_field_gives_yaw_from_its_azimuth(tumble: Callable) -> None:
    tumbled = tumble(seed=2)
    _, run = follow_attitude(
        begin(tumbled.samples, learned_reference(), PLAIN), tumbled.samples, learned_reference(), PLAIN
    )
    north = Rotation.from_euler("z", np.arctan2(tumbled.field_uT[1], tumbled.field_uT[0]))
    shown = (north * Rotation.from_quat(run.q_body_to_building, scalar_first=True)).as_quat(scalar_first=True)
    assert _deg(tumbled.error_rad(shown)[500:]) < 1.0


def test_a_level_reference_does_the_same(tumble: Callable) -> None:
    tumbled = tumble(seed=2)
    x, y, z = tumbled.field_uT
    reference = level_reference(float(np.hypot(x, y)), z)
    _, run = follow_attitude(begin(tumbled.samples, reference, WHITE), tumbled.samples, reference, WHITE)
    shown = Rotation.from_euler("z", np.arctan2(y, x)) * Rotation.from_quat(run.q_body_to_building, scalar_first=True)
    assert _deg(tumbled.error_rad(shown.as_quat(scalar_first=True))[500:]) < 0.5


@given(st.lists(st.integers(1, 899), max_size=6, unique=True))
@settings(max_examples=15)
def test_chunks_give_the_same_bits(tumble: Callable, cuts: list[int]) -> None:
    samples = _cut(tumble(seed=4, seconds=12.0).samples, 0, 900)
    samples.magnetometer_uT[::3] = np.nan
    reference = learned_reference()
    start = begin(samples, reference)
    whole_state, whole = follow_attitude(start, samples, reference)
    bounds = [0, *sorted(cuts), 900]
    state, parts = start, []
    for a, b in pairwise(bounds):
        state, run = follow_attitude(state, _cut(samples, a, b), reference)
        parts.append(run)
    for name in AttitudeRun.__dataclass_fields__:
        assert np.array_equal(np.concatenate([getattr(each, name) for each in parts]), getattr(whole, name)), name
    for name in AttitudeState.__dataclass_fields__:
        assert np.array_equal(getattr(state, name), getattr(whole_state, name), equal_nan=True), name


def test_the_state_given_is_left_as_it_is(tumble: Callable) -> None:
    samples = tumble().samples
    state = begin(samples, None)
    before = [getattr(state, name).copy() for name in AttitudeState.__dataclass_fields__]
    follow_attitude(state, samples, None)
    for old, name in zip(before, AttitudeState.__dataclass_fields__, strict=True):
        assert np.array_equal(old, getattr(state, name), equal_nan=True)


@pytest.mark.slow
def test_the_covariance_is_honest(tumble: Callable) -> None:
    """NEES of attitude over 60 runs: three on average, under white noise of the sizes the filter is told."""
    noise = ImuNoise(accelerometer_bias_m_per_s2=0.0, accelerometer_m_per_s2=0.5, magnetometer_uT=np.hypot(0.7, 0.3))
    options = replace(WHITE, translation="ignored", accelerometer_correlation_s=0.0, gyro_scale=0.0,
                      rest_detection=False, gyro_bias_rad_per_s=0.005, learn_hard_iron=False)  # fmt: skip
    nees = []
    for seed in range(60):
        tumbled = tumble(seed=seed, seconds=20.0, noise=noise, sway_m=0.0)
        reference = constant_reference(tumbled.field_uT)
        _, run = follow_attitude(begin(tumbled.samples, reference, options), tumbled.samples, reference, options)
        e = tumbled.error_rad(run.q_body_to_building)[500::250]
        nees.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(run.covariance_rad2[500::250]), e))
    mean = np.mean(nees)
    assert 2.5 < mean < 3.5, mean


def test_a_wrong_start_is_honest_until_it_is_mended(tumble: Callable) -> None:
    tumbled = tumble(seed=7)
    state = begin(tumbled.samples, None)
    up = Rotation.from_quat(state.q_body_to_building, scalar_first=True).as_matrix()[2]
    assert up @ state.covariance[:3, :3] @ up == pytest.approx(np.pi**2 / 3.0)


@pytest.mark.parametrize("translation", ["bounded", "ignored"])
@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.6, 0.0, 0.8]])
def test_half_a_turn_of_error_is_recovered_from(tumble: Callable, translation: str, axis: list[float]) -> None:
    """Confident and 180 degrees wrong, where the innovation has no slope: gates reject, then believe again."""
    tumbled = tumble(seed=8, sway_m=0.02)
    options = replace(WHITE, translation=translation)  # type: ignore[arg-type]
    reference = constant_reference(tumbled.field_uT)
    state, _ = follow_attitude(
        begin(tumbled.samples, reference, options), _cut(tumbled.samples, 0, 500), reference, options
    )
    half = Rotation.from_rotvec(np.pi * np.array(axis)) * Rotation.from_quat(
        state.q_body_to_building, scalar_first=True
    )
    kept = state.kept.copy()
    kept[layout.SUM_WEIGHT : layout.SUM_END] = 0.0  # what was summed in the frame that is now forgotten
    wrong = replace(state, q_body_to_building=half.as_quat(scalar_first=True), kept=kept)
    _, run = follow_attitude(wrong, _cut(tumbled.samples, 500, 4000), reference, options)
    truth = Rotation.from_quat(tumbled.truth[500:], scalar_first=True)
    error = (Rotation.from_quat(run.q_body_to_building, scalar_first=True).inv() * truth).magnitude()
    assert np.rad2deg(error[0]) > 90.0
    assert np.rad2deg(error[-500:]).max() < 5.0


def test_spikes_are_gated(tumble: Callable) -> None:
    tumbled = tumble(seed=9)
    reference = constant_reference(tumbled.field_uT)
    spiked = np.arange(1000, 4000, 97)
    tumbled.samples.magnetometer_uT[spiked] += [120.0, -80.0, 60.0]
    _, run = follow_attitude(begin(tumbled.samples, reference, WHITE), tumbled.samples, reference, WHITE)
    assert not run.magnetometer_used[spiked].any()
    assert run.disturbed[spiked].all()
    assert _deg(tumbled.error_rad(run.q_body_to_building)[500:]) < 0.6


def test_a_disturbed_room_is_sat_out(tumble: Callable) -> None:
    """Twelve seconds beside a strong magnet: yaw is carried on by the gyro, and the field is believed again after."""
    tumbled = tumble(seed=10)
    attitude = Rotation.from_quat(tumbled.truth[1500:2700], scalar_first=True)
    tumbled.samples.magnetometer_uT[1500:2700] += attitude.inv().apply([15.0, -20.0, 12.0])
    reference = learned_reference()
    _, run = follow_attitude(begin(tumbled.samples, reference, PLAIN), tumbled.samples, reference, PLAIN)
    north = Rotation.from_euler("z", np.arctan2(tumbled.field_uT[1], tumbled.field_uT[0]))
    shown = north * Rotation.from_quat(run.q_body_to_building, scalar_first=True)
    error = tumbled.error_rad(shown.as_quat(scalar_first=True))
    assert run.disturbed[1550:2700].mean() > 0.9
    assert not run.disturbed[3600:].any()
    assert np.rad2deg(np.abs(error[1500:]).max()) < 4.0


@pytest.mark.parametrize("kind", ["learned", "known"])
def test_a_magnet_put_on_the_device_is_learned(tumble: Callable, kind: str) -> None:
    tumbled = tumble(seed=11, seconds=60.0)
    tumbled.samples.magnetometer_uT[2000:] += [18.0, -9.0, 14.0]
    reference = learned_reference() if kind == "learned" else constant_reference(tumbled.field_uT)
    state, _ = follow_attitude(begin(tumbled.samples, reference, PLAIN), tumbled.samples, reference, PLAIN)
    assert np.linalg.norm(state.hard_iron_uT - [18.0, -9.0, 14.0]) < 2.0


def test_a_field_learned_with_a_magnet_on_the_device_is_mended(tumble: Callable) -> None:
    """Yaw counts from a wrong north until the body turns; then hard iron and field are told apart."""
    tumbled = tumble(seed=16)
    tumbled.samples.magnetometer_uT[:] += [25.0, -10.0, 40.0]
    reference = learned_reference()
    state, run = follow_attitude(begin(tumbled.samples, reference, PLAIN), tumbled.samples, reference, PLAIN)
    north = Rotation.from_euler("z", np.arctan2(tumbled.field_uT[1], tumbled.field_uT[0]))
    shown = north * Rotation.from_quat(run.q_body_to_building, scalar_first=True)
    error = np.rad2deg(np.linalg.norm(tumbled.error_rad(shown.as_quat(scalar_first=True)), axis=1))
    assert error[400] > 8.0
    assert error[2000:].max() < 11.0
    assert error[-1] < 6.0
    assert np.linalg.norm(state.hard_iron_uT - [25.0, -10.0, 40.0]) < 2.0


def test_north_stays_where_it_was_when_the_room_changes_for_good(tumble: Callable) -> None:
    tumbled = tumble(seed=17, seconds=60.0)
    attitude = Rotation.from_quat(tumbled.truth[1500:], scalar_first=True)
    tumbled.samples.magnetometer_uT[1500:] += attitude.inv().apply([15.0, -25.0, 20.0])
    options, reference = replace(PLAIN, new_field_s=10.0), learned_reference()
    state, run = follow_attitude(begin(tumbled.samples, reference, options), tumbled.samples, reference, options)
    north = Rotation.from_euler("z", np.arctan2(tumbled.field_uT[1], tumbled.field_uT[0]))
    shown = north * Rotation.from_quat(run.q_body_to_building, scalar_first=True)
    error = np.rad2deg(np.linalg.norm(tumbled.error_rad(shown.as_quat(scalar_first=True)), axis=1))
    assert not run.magnetometer_used[1550:2400].any()
    assert run.magnetometer_used[-1000:].all()
    assert np.linalg.norm(state.field_uT) == pytest.approx(np.linalg.norm([29.0, -17.0, -22.0]), rel=0.1)
    assert error[1500:].max() < 4.0


def test_streams_have_rates_of_their_own(tumble: Callable) -> None:
    """A magnetometer at 144 Hz beside an IMU at 200 Hz (Kuevor, L1047), merged by time, is as good as one clock."""
    tumbled = tumble(seed=12, rate_hz=1000.0, seconds=20.0, turn_rad_per_s=0.5)
    n = len(tumbled.truth)
    imu, slow = np.arange(n) % 5 == 0, np.arange(n) % 7 == 0
    keep = imu | slow
    s = tumbled.samples
    gyro = np.full((n, 3), np.nan)
    gyro[imu] = np.diff(np.concatenate([[[0.0] * 3], np.cumsum(s.gyro_rad_per_s, axis=0)[imu]]), axis=0) / 5.0
    samples = InertialSamples(
        s.t_s[keep],
        gyro[keep],
        np.where(imu[:, None], s.accelerometer_m_per_s2, np.nan)[keep],
        np.where(slow[:, None], s.magnetometer_uT, np.nan)[keep],
    )
    reference = constant_reference(tumbled.field_uT)
    _, run = follow_attitude(begin(samples, reference, WHITE), samples, reference, WHITE)
    truth = Rotation.from_quat(tumbled.truth[keep], scalar_first=True)
    error = (Rotation.from_quat(run.q_body_to_building, scalar_first=True).inv() * truth).as_rotvec()
    assert _deg(error[2000:]) < 0.6


def test_more_of_a_correlated_stream_teaches_no_more(tumble: Callable) -> None:
    fine = tumble(seed=13, rate_hz=400.0, seconds=10.0, rest_s=20.0).samples
    coarse = InertialSamples(
        fine.t_s[::8], fine.gyro_rad_per_s[::8], fine.accelerometer_m_per_s2[::8], fine.magnetometer_uT[::8]
    )
    reference, sds = constant_reference(np.array([14.0, 8.0, -42.0])), []
    options = replace(PLAIN, magnetometer_uT=0.01)
    for samples in (fine, coarse):
        _, run = follow_attitude(begin(samples, reference, options), samples, reference, options)
        sds.append(np.sqrt(run.covariance_rad2[-1, 2, 2]))
    assert sds[0] == pytest.approx(sds[1], rel=0.1)


def test_missing_rows_cost_certainty_and_nothing_else(tumble: Callable) -> None:
    tumbled = tumble(seed=14)
    reference = constant_reference(tumbled.field_uT)
    tumbled.samples.accelerometer_m_per_s2[1000:1200] = np.nan
    tumbled.samples.magnetometer_uT[1500:2500] = np.nan
    _, run = follow_attitude(begin(tumbled.samples, reference, WHITE), tumbled.samples, reference, WHITE)
    up = Rotation.from_quat(run.q_body_to_building, scalar_first=True).as_matrix()[:, 2]
    yaw = np.einsum("ni,nij,nj->n", up, run.covariance_rad2, up)
    assert np.isfinite(run.q_body_to_building).all()
    assert not run.magnetometer_used[1500:2500].any()
    assert yaw[2499] > 1.3 * yaw[1499]
    assert _deg(tumbled.error_rad(run.q_body_to_building)[500:]) < 0.8


def test_a_long_gap_is_not_bridged_with_confidence(tumble: Callable) -> None:
    tumbled = tumble(seed=15)
    reference = constant_reference(tumbled.field_uT)
    state, before = follow_attitude(
        begin(tumbled.samples, reference, WHITE), _cut(tumbled.samples, 0, 1500), reference, WHITE
    )
    _, after = follow_attitude(state, _cut(tumbled.samples, 1800, 4000), reference, WHITE)
    error = tumbled.error_rad(
        np.concatenate([np.tile(before.q_body_to_building[:1], (1800, 1)), after.q_body_to_building])
    )
    assert np.trace(after.covariance_rad2[0]) > 0.3
    assert np.rad2deg(np.linalg.norm(error[3000:], axis=1)).max() < 3.0


def test_what_cannot_be_used_is_refused(tumble: Callable) -> None:
    samples = tumble(seconds=8.0).samples
    state, _ = follow_attitude(begin(samples, None), samples, None)
    with pytest.raises(InvalidInput, match="send later ones"):
        follow_attitude(state, samples, None)
    with pytest.raises(InvalidInput, match="sort the samples"):
        replace(samples, t_s=samples.t_s[::-1])
    with pytest.raises(InvalidInput, match="one row of three"):
        replace(samples, gyro_rad_per_s=samples.gyro_rad_per_s[1:])
    with pytest.raises(InvalidInput, match="gravity is needed"):
        begin(replace(samples, accelerometer_m_per_s2=np.full_like(samples.gyro_rad_per_s, np.nan)), None)
    with pytest.raises(InvalidInput, match="row of three for each"):
        begin(samples, MagneticReference(np.zeros((5, 3))))
    with pytest.raises(InvalidInput, match="not negative"):
        follow_attitude(begin(samples, None), samples, None, AttitudeOptions(field_uT=-1.0))
    with pytest.raises(InvalidInput, match="no sensor is certain"):
        follow_attitude(begin(samples, None), samples, None, AttitudeOptions(magnetometer_uT=0.0))
