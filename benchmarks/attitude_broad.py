"""Attitude of a body sensor in a field that is not known: ours beside VQF, Madgwick, Mahony and an EKF, on BROAD.

BROAD (Laidig, Caruso, Cereatti and Seel 2021) has gyro, accelerometer and magnetometer at 286 Hz and optical truth.
Errors are of the samples flagged `movement`, root mean square in degrees: total, of heading, of inclination. The
optical frame and magnetic north differ by an angle that nobody knows: the mean heading error of a trial is taken off
first; "as is" is the total error without that. The causal filters stand together, and those that know the whole log.

Ours and VQF (Laidig and Seel 2023) run with their defaults on all trials. Ours reports the attitude 2.5 ms ahead of the
last reading, the delay that common gyros state; "VQF ahead" is VQF with the same added to its answer.

    python benchmarks/attitude_broad.py [folder]      needs h5py, vqf and ahrs; all *.hdf5 of the folder
    exits 1 where ours is worse than VQF on an undisturbed trial, or not better on a disturbed one
"""

import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from app.attitude.mekf import begin, follow_attitude
from app.attitude.options import AttitudeOptions, InertialSamples
from app.attitude.reference import learned_reference
from app.attitude.smooth import smooth_attitude

FOLDER = Path(os.environ.get("ISODYN_DATA", "../shared/data")) / "broad"
LEAD_S = AttitudeOptions().gyro_delay_s
NORTH = Rotation.from_euler("z", np.pi / 2)  # ours counts yaw from north along x; BROAD's frame is east-north-up
Trial = dict[str, Any]


def read_trial(path: Path) -> Trial:
    """gyro, acc, mag (n, 3), truth (n, 4), moving (n,) and rate_hz of a file of BROAD."""
    import h5py

    with h5py.File(path) as file:
        truth = file["opt_quat"][:]
        return {
            "gyro": np.ascontiguousarray(file["imu_gyr"][:]),
            "acc": np.ascontiguousarray(file["imu_acc"][:]),
            "mag": np.ascontiguousarray(file["imu_mag"][:]),
            "truth": truth,
            "moving": file["movement"][:].astype(bool) & np.isfinite(truth).all(axis=1),
            "rate_hz": float(file.attrs["sampling_rate"]),
        }


def errors_deg(q: np.ndarray, trial: Trial) -> tuple[float, float, float, float]:
    """Total, heading, inclination with the mean heading error taken off, and total as is."""
    moving = trial["moving"]
    estimate, truth = (Rotation.from_quat(each[moving], scalar_first=True) for each in (q, trial["truth"]))
    off = (estimate * truth.inv()).as_quat(scalar_first=True)
    offset = np.angle(np.mean(np.exp(2j * np.arctan2(off[:, 3], off[:, 0]))))
    aligned = (Rotation.from_euler("z", -offset) * estimate * truth.inv()).as_quat(scalar_first=True)
    heading = 2.0 * np.arctan2(np.abs(aligned[:, 3]), np.abs(aligned[:, 0]))
    inclination = 2.0 * np.arccos(np.clip(np.hypot(aligned[:, 0], aligned[:, 3]), 0.0, 1.0))
    angles = (_angle(aligned), heading, inclination, _angle(off))
    total, of_heading, of_inclination, as_is = (float(np.rad2deg(np.sqrt(np.mean(each**2)))) for each in angles)
    return total, of_heading, of_inclination, as_is


def _angle(q: np.ndarray) -> np.ndarray:
    return np.asarray(2.0 * np.arccos(np.clip(np.abs(q[:, 0]), 0.0, 1.0)))


def missing(folder: Path) -> str:
    """What this needs and is not there; empty where all is."""
    lacking = [name for name in ("h5py", "vqf", "ahrs") if find_spec(name) is None]
    if lacking:
        return f"pip install {' '.join(lacking)}"
    return (
        ""
        if any(folder.glob("*.hdf5"))
        else f"no trials in {folder}; get github.com/dlaidig/broad and give its data folder"
    )


def samples_of(trial: Trial) -> InertialSamples:
    t = np.arange(len(trial["gyro"])) / trial["rate_hz"]
    return InertialSamples(t, trial["gyro"], trial["acc"], trial["mag"])


def _east_north_up(q: np.ndarray) -> np.ndarray:
    return np.asarray((NORTH * Rotation.from_quat(q, scalar_first=True)).as_quat(scalar_first=True))


def ours(trial: Trial) -> np.ndarray:
    samples, reference = samples_of(trial), learned_reference()
    _, run = follow_attitude(begin(samples, reference), samples, reference)
    return _east_north_up(run.q_body_to_building)


def ours_whole_log(trial: Trial) -> np.ndarray:
    return _east_north_up(smooth_attitude(samples_of(trial), learned_reference()).q_body_to_building)


def vqf_causal(trial: Trial) -> np.ndarray:
    from vqf import VQF

    return np.asarray(VQF(1.0 / trial["rate_hz"]).updateBatch(trial["gyro"], trial["acc"], trial["mag"])["quat9D"])


def vqf_ahead(trial: Trial) -> np.ndarray:
    lead = Rotation.from_rotvec(LEAD_S * trial["gyro"])
    return np.asarray((Rotation.from_quat(vqf_causal(trial), scalar_first=True) * lead).as_quat(scalar_first=True))


def vqf_whole_log(trial: Trial) -> np.ndarray:
    from vqf import offlineVQF

    return np.asarray(offlineVQF(trial["gyro"], trial["acc"], trial["mag"], 1.0 / trial["rate_hz"], {})["quat9D"])


def _ahrs(name: str, **options: Any) -> Callable[[Trial], np.ndarray]:
    def run(trial: Trial) -> np.ndarray:
        import ahrs

        streams = {"gyr": trial["gyro"], "acc": trial["acc"], "mag": trial["mag"], "frequency": trial["rate_hz"]}
        q = np.asarray(getattr(ahrs.filters, name)(**streams, **options).Q)
        return _upright(q, trial)

    return run


def _upright(q: np.ndarray, trial: Trial) -> np.ndarray:
    """The quaternion or its conjugate, whichever levels the accelerometer: the filters of ahrs do not agree on one."""
    force = trial["acc"][:: len(q) // 500]
    rotation = Rotation.from_quat(q[:: len(q) // 500], scalar_first=True)
    up = [float(np.abs(each.apply(force)[:, 2]).mean()) for each in (rotation, rotation.inv())]
    chosen = Rotation.from_quat(q, scalar_first=True)
    chosen = chosen if up[0] >= up[1] else chosen.inv()
    if np.mean(chosen.apply(trial["acc"])[:, 2]) < 0.0:  # z down
        chosen = Rotation.from_euler("x", np.pi) * chosen
    return np.asarray(chosen.as_quat(scalar_first=True))


CAUSAL = {"ours": ours, "VQF": vqf_causal, "VQF ahead": vqf_ahead, "Madgwick": _ahrs("Madgwick"),
          "Mahony": _ahrs("Mahony"), "EKF": _ahrs("EKF", frame="ENU")}  # fmt: skip
WHOLE_LOG = {"ours": ours_whole_log, "VQF": vqf_whole_log}


def main() -> int:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER
    paths = sorted(folder.glob("*.hdf5"))
    if why := missing(folder):
        print(f"skipped: {why}")
        return 0
    totals: dict[str, dict[str, tuple[float, ...]]] = {}
    for path in paths:
        trial = read_trial(path)
        rows = totals[path.stem] = {name: errors_deg(run(trial), trial) for name, run in CAUSAL.items()}
        rows |= {f"{name}, whole log": errors_deg(run(trial), trial) for name, run in WHOLE_LOG.items()}
        print(f"\n{path.stem}\n  {'':18s}  total  heading  inclination  as is  total / VQF")
        for name, row in rows.items():
            beside = rows["VQF, whole log" if "whole" in name else "VQF"][0]
            print(
                f"  {name:18s} {row[0]:6.2f}   {row[1]:6.2f}       {row[2]:6.2f} {row[3]:6.2f}   {row[0] / beside:6.2f}"
            )
    return summarise(totals)


def summarise(totals: dict[str, dict[str, tuple[float, ...]]]) -> int:
    """Means over undisturbed and disturbed trials, and whether the target is met; the exit code."""
    for kind in ("undisturbed", "disturbed"):
        rows = [row for name, row in totals.items() if f"_{kind}_" in name]
        if rows:
            print(f"\nmean of {len(rows)} {kind} trials: total / as is")
            for name in rows[0]:
                total, as_is = (np.mean([row[name][column] for row in rows]) for column in (0, 3))
                print(f"  {name:18s} {total:6.2f} {as_is:6.2f}")
    missed = [
        name
        for name, row in totals.items()
        if row["ours"][0] > row["VQF"][0] or ("_disturbed_" in name and row["ours"][0] >= row["VQF"][0])
    ]
    print("\ntarget (causal, total): no worse than VQF where undisturbed, better where disturbed:",
          "met on all" if not missed else f"missed on {', '.join(missed)}")  # fmt: skip
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
