"""What Brommer et al. (2020) report of disturbance detection, tried again: every figure beside its target.

Simulation as theirs (Brommer, L141-148), with what they do not print drawn here: ten minutes at 50 Hz, a tumbling body,
noise of Table I in the sensor's axes, counts for microtesla throughout. No accelerometer.
Real: trials of the BROAD benchmark, one of them tapped, which disturbs no field.

    python benchmarks/brommer.py [--seeds 4] [--no-broad]        exits 1 where a required figure is missed
"""

import argparse
import os
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from app.attitude.dip_angle import dip_angle, followed_up
from app.attitude.disturbance import OutlierRule, critical_value, detection_power
from app.attitude.field_belief import FieldFilter, InitialSpread, initial_belief
from app.attitude.field_log import FieldLog, filter_log
from app.attitude.magnitude_log import follow_magnitude
from app.attitude.spherical_field import (
    cartesian_jacobian,
    from_spherical,
    predict_spherical,
    spherical_jacobian,
    to_spherical,
)

BROAD = Path(os.environ.get("ISODYN_TEST_DATA", "../shared/data")) / "broad"
FIELD, SENSOR_SD = np.array([-103.622, 1157.296, 2175.026]), (14.668, 16.293, 21.162)
FIXED_SD = (19.823, float(np.deg2rad(0.415)), float(np.deg2rad(0.725)))
RATE_HZ, SECONDS, STEP_S = 50.0, 600.0, 300.0
GYRO_NOISE, TUMBLE_SD, TUMBLE_S = 2e-3, 0.7, 2.0
SPREAD = InitialSpread(float(np.deg2rad(5.0)), 0.0, 0.0, float(np.deg2rad(5.0)), 200.0)
FILTER = FieldFilter(
    sensor_sd_uT=SENSOR_SD,
    fixed_sd=FIXED_SD,
    reset_sd_uT=200.0,
    gyro_noise_rad_per_s=GYRO_NOISE,
    reject=False,
    adapt=False,
)
THREE = OutlierRule(threshold=critical_value(3))
NOMINAL, WITHIN = 0.27, 0.10
BROAD_GROUP = 6
ROOM_SD_UT, ROOM_WALK_UT = 1.1, 0.1
"""By which a field without disturbance varies as one moves and turns in a room: steel of the house, calibration."""
ROOM_SD_DEG, ROOM_WALK_DEG = 2.5, 0.2
"""The same of the dip, errors of up included."""


class Run(NamedTuple):
    """A simulated log, and what the filter is told at its start."""

    t_s: np.ndarray
    gyro_rad_per_s: np.ndarray
    B_uT: np.ndarray
    q_body_to_building: np.ndarray
    q_sensor_to_body: np.ndarray
    first_uT: np.ndarray


def simulate(seed: int, step_uT: np.ndarray | None = None, seconds: float = SECONDS) -> Run:
    rng = np.random.default_rng(seed)
    n, dt = round(seconds * RATE_HZ), 1.0 / RATE_HZ
    rate = np.zeros((n, 3))
    keep = np.exp(-dt / TUMBLE_S)
    for k in range(1, n):
        rate[k] = keep * rate[k - 1] + np.sqrt(1.0 - keep**2) * TUMBLE_SD * rng.normal(size=3)
    attitude = Rotation.random(rng=rng)
    quaternions = np.empty((n, 4))
    for k, turn in enumerate(Rotation.from_rotvec(rate * dt)):
        attitude = attitude * turn
        quaternions[k] = attitude.as_quat(scalar_first=True)
    body = Rotation.from_quat(quaternions, scalar_first=True)
    extrinsic = Rotation.from_rotvec(0.3 * rng.normal(size=3))
    B = np.tile(FIELD, (n, 1))
    t = np.arange(n) * dt
    if step_uT is not None:
        B[t >= STEP_S] += step_uT
    reading = extrinsic.inv().apply(body.inv().apply(B)) + rng.normal(size=(n, 3)) * SENSOR_SD
    gyro = rate + GYRO_NOISE / np.sqrt(dt) * rng.normal(size=(n, 3))
    believed = body[0] * Rotation.from_rotvec(np.deg2rad(5.0) * rng.normal(size=3))
    mounted = extrinsic * Rotation.from_rotvec(np.deg2rad(5.0) * rng.normal(size=3))
    first = mounted.inv().apply(believed.inv().apply(FIELD + 200.0 * rng.normal(size=3)))
    return Run(t, gyro, reading, believed.as_quat(scalar_first=True), mounted.as_quat(scalar_first=True), first)


def run(log: Run, filter_: FieldFilter) -> FieldLog:
    belief = initial_belief(filter_, log.q_body_to_building, log.first_uT, SPREAD, log.q_sensor_to_body)
    return filter_log(belief, filter_, log.t_s, log.gyro_rad_per_s, log.B_uT)


def report(what: str, measured: str, target: str, passed: bool | None = None) -> bool:
    verdict = "" if passed is None else "  ok" if passed else "  MISSED"
    print(f"{what:68s} {measured:>28s}   {target}{verdict}")
    return passed is not False


def table_one() -> bool:
    """The sensor's statistics from its Cartesian ones (Brommer, L57-68, Table I)."""
    r, theta, phi = to_spherical(FIELD)
    J = spherical_jacobian(FIELD)
    sd = np.sqrt(np.diag(J @ np.diag(np.square(SENSOR_SD)) @ J.T))
    ok = report("Table I: magnitude, counts", f"{r:.2f} +- {sd[0]:.2f}", "2466.039 +- 19.823 (0.2; 3 %)",
                abs(r - 2466.039) < 0.2 and abs(sd[0] / 19.823 - 1) < 0.03)  # fmt: skip
    elevation, azimuth = 90.0 - np.degrees(theta), np.degrees(phi)
    for name, angle, spread, printed, printed_sd in (
        ("elevation", elevation, np.degrees(sd[1]), 61.885, 0.415),
        ("azimuth", azimuth, np.degrees(sd[2]), 95.116, 0.725),
    ):
        near = abs(angle - printed) < 0.01 and abs(spread / printed_sd - 1) < 0.03
        target = f"{printed} +- {printed_sd} (0.01; 3 %)"
        ok &= report(f"Table I: {name}, degrees", f"{angle:.3f} +- {spread:.3f}", target, bool(near))
    return ok


def magnitude_row() -> bool:
    """The row is [0 0 0 | 0 0 0 | 1 0 0]: also by the full product, to rounding."""
    rng, worst, rounding = np.random.default_rng(0), 0.0, 0.0
    for _ in range(1000):
        body, sensor = Rotation.random(rng=rng).as_matrix(), Rotation.random(rng=rng).as_matrix()
        m = np.array([rng.uniform(20.0, 3000.0), rng.uniform(0.1, 3.0), rng.uniform(0.0, 6.28)])
        seen = predict_spherical(body, sensor, m)
        row = np.concatenate([seen.by_attitude[0], seen.by_extrinsic[0], seen.by_field[0]])
        worst = max(worst, float(np.abs(row - np.eye(9)[6]).max()))
        B_body = body.T @ from_spherical(m)
        first = spherical_jacobian(sensor.T @ B_body)[0]
        by_hand = [np.cross(first @ sensor.T, B_body) / m[0], first @ sensor.T @ body.T @ cartesian_jacobian(m)]
        rounding = max(rounding, float(np.abs(np.concatenate(by_hand) / [1, 1, 1, 1, m[0], m[0]] - np.eye(6)[3]).max()))
    report("  the same by the full product, to rounding", f"{rounding:.1e}", "below 1e-12", rounding < 1e-12)
    return report("magnitude row less [0 0 0 | 0 0 0 | 1 0 0], 1,000 random states", f"{worst:.1e}", "0", worst == 0.0)


def rates(seeds: int) -> bool:
    """Outliers of 30,000 undisturbed readings a seed (Brommer, L159-165, Table IV)."""
    cases = {
        "spherical magnitude, R = J R J'": (FILTER, "0.21"),
        "spherical magnitude, fixed R": (FILTER._replace(rotate_noise=False), "0.21"),
        "spherical, three residuals, R = J R J'": (FILTER._replace(vector_test=True, rule=THREE), "-"),
        "spherical, three residuals, fixed R": (FILTER._replace(vector_test=True, rule=THREE, rotate_noise=False), "-"),
        "Cartesian, three residuals": (FILTER._replace(spherical=False, vector_test=True, rule=THREE), "0.14"),
        "Cartesian norm, one degree of freedom": (FILTER._replace(spherical=False), "1.14"),
        "Cartesian norm, three as printed": (FILTER._replace(spherical=False, rule=THREE), "1.14"),
    }
    logs = [simulate(seed) for seed in range(seeds)]
    passed = True
    for name, (filter_, printed) in cases.items():
        found = [100.0 * float(run(log, filter_).outlier.mean()) for log in logs]
        mean, target, ok = float(np.mean(found)), f"paper {printed} %", None
        if name == "spherical magnitude, R = J R J'":
            target, ok = f"0.27 +- 0.1 % every seed; {target}", max(abs(f - NOMINAL) for f in found) <= WITHIN
        if name == "spherical magnitude, fixed R":
            target, ok = f"below 0.27 % every seed; {target}", max(found) < NOMINAL
        spread = ", ".join(f"{f:.2f}" for f in found)
        passed &= report(f"outliers: {name}", f"{mean:.3f} % ({spread})", target, ok)
    return passed


def steps(seeds: int) -> bool:
    """A step along the field at 300 s, and the one printed, of (100, 10, 10) (Brommer, L148, L197-203)."""
    along = 101.0 * FIELD / np.linalg.norm(FIELD)
    filter_ = FILTER._replace(adapt=True, reject=True)
    delay, back, printed, frozen = [], [], 0, []
    for seed in range(seeds):
        log = run(simulate(seed, along), filter_)
        found = np.flatnonzero(log.found) / RATE_HZ
        delay.append(float(found[0]) - STEP_S if len(found) else np.inf)
        after = np.abs(log.field[:, 0] - np.linalg.norm(FIELD) - 101.0) < 5.0
        late = np.flatnonzero(after & (np.arange(len(after)) > STEP_S * RATE_HZ))
        back.append(float(late[0]) / RATE_HZ - STEP_S if len(late) else np.inf)
        printed += int(run(simulate(seed, np.array([100.0, 10.0, 10.0])), filter_).found.sum())
        held = run(simulate(seed, along), filter_._replace(adapt=False, reject=False))
        frozen.append(float(held.field[-1, 0] - np.linalg.norm(FIELD) - 101.0))
    first = max(delay)
    ok = report("step of 101 along the field: adapted after, s", ", ".join(f"{d:.2f}" for d in delay),
                "0.20 (the 11th reading) in most; see power", min(delay) <= 0.2 + 1e-9 and first < 5.0)  # fmt: skip
    ok &= report(
        "  magnitude within 5 counts after, s", ", ".join(f"{b:.2f}" for b in back), "paper 1.5 s", max(back) < 5.0
    )
    ok &= report(
        "step of (100, 10, 10) as printed: disturbances found",
        str(printed),
        "never (11 counts of magnitude)",
        printed == 0,
    )
    report(
        "without adaptation, counts off after 300 s",
        ", ".join(f"{f:.0f}" for f in frozen),
        "about -50: the mean moves as 1/n",
    )
    return ok


def power_of_steps() -> bool:
    """First eleven readings after a step all fail, the belief frozen: Phi(k - 3)^11."""
    rng, trials, passed = np.random.default_rng(1), 4000, True
    for k in (3.5, 4.0, 4.5, 5.0, 6.0):
        z = rng.normal(size=(trials, 11)) + k
        hits = sum(
            bool(follow_magnitude(np.arange(11) / RATE_HZ, row, 1.0, start=(0.0, 1e-12)).found.any()) for row in z
        )
        expected = float(detection_power(k))
        miss = abs(hits / trials - expected) / np.sqrt(expected * (1 - expected) / trials)
        passed &= report(f"found at once, step of {k} sds", f"{hits / trials:.3f}", f"{expected:.3f}", bool(miss < 4.0))
    return passed


def runtime() -> bool:
    log = simulate(0, seconds=100.0)
    run(log, FILTER)
    best = min(_timed(log) for _ in range(5)) / len(log.t_s) * 1e6
    return report(
        "one prediction and update, compiled, microseconds", f"{best:.1f}", "paper 400 (workstation)", best < 400.0
    )


def _timed(log: Run) -> float:
    start = time.process_time()
    run(log, FILTER)
    return time.process_time() - start


def broad() -> bool:
    """Shares of the movement that are outliers and that are called disturbed, by the magnitude and by the dip."""
    import h5py

    print("BROAD, 48 readings a second; outliers and disturbed share of the movement: magnitude; dip")
    shares = {}
    for file in sorted(BROAD.glob("*.hdf5")):
        with h5py.File(file) as trial:
            gyro, force, B, moving = (np.asarray(trial[k]) for k in ("imu_gyr", "imu_acc", "imu_mag", "movement"))
            rate = float(trial.attrs["sampling_rate"])
        t = np.arange(len(B)) / rate
        up = followed_up(t, gyro, force)
        groups = len(B) // BROAD_GROUP
        moving = moving[: groups * BROAD_GROUP : BROAD_GROUP].astype(bool)
        t, B, up = (_grouped(values, groups) for values in (t, B, up))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        dip_deg = np.degrees(dip_angle(B, up, np.eye(3), 0.0).angle_rad)
        rule = OutlierRule(lasting_s=0.2)
        logs = [
            follow_magnitude(t, values, sd**2, rule=rule, walk_psd_uT2_per_s=walk**2, start=(first, sd**2))
            for values, sd, walk, first in (
                (np.linalg.norm(B, axis=1), ROOM_SD_UT, ROOM_WALK_UT, float(np.linalg.norm(B[:200], axis=1).mean())),
                (dip_deg, ROOM_SD_DEG, ROOM_WALK_DEG, float(dip_deg[:200].mean())),
            )
        ]
        both = logs[0].disturbed | logs[1].disturbed
        found = [f"{100 * log.outlier[moving].mean():5.1f} {100 * log.disturbed[moving].mean():5.1f} %" for log in logs]
        events = " and ".join(str(len(log.events)) for log in logs)
        print(f"  {file.stem:38s} {'; '.join(found)}; either {100 * both[moving].mean():5.1f} %, events {events}")
        shares[file.stem] = float(both[moving].mean())
    quiet = max(share for name, share in shares.items() if "undisturbed" in name or "tapping" in name)
    loud = {name: share for name, share in shares.items() if "magnet" in name}
    attached = min(share for name, share in loud.items() if "attached" in name)
    passing = min(share for name, share in loud.items() if "stationary" in name)
    ok = report(
        "BROAD: undisturbed or tapped, called disturbed at most", f"{100 * quiet:.1f} %", "below 2 %", quiet < 0.02
    )
    ok &= report("BROAD: magnet attached", f"{100 * attached:.1f} %", "above 30 %", attached > 0.3)
    return ok & report("BROAD: magnet in the room", f"{100 * passing:.1f} %", "more than undisturbed", passing > quiet)


def _grouped(values: np.ndarray, groups: int) -> np.ndarray:
    return values[: groups * BROAD_GROUP].reshape(groups, BROAD_GROUP, *values.shape[1:]).mean(axis=1)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--no-broad", action="store_true")
    arguments = parser.parse_args()
    passed = table_one() & magnitude_row() & rates(arguments.seeds) & steps(arguments.seeds)
    passed &= power_of_steps() & runtime()
    if not arguments.no_broad and BROAD.is_dir():
        passed &= broad()
    print("PASS" if passed else "FAIL")
    return 0 if passed else 1


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
