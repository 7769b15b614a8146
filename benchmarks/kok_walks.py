"""Maps of precise handheld walks: white or walk-correlated noise, without and with a bias of the sensor in its axes.

The walks of manonkok/1d-magnetic-field-slam (iPad, ARKit pose, 10 Hz): square, eight, library, mall. A map is fitted
from the first visits and asked where the same walk comes again, in two ways: `first visits` maps every sample that has
no earlier one within 0.7 m, at least 5 m of walking before, and asks all others; `halves` maps the first half of the
path and asks the samples of the second that come within 0.7 m of it. The bias is found from the mapped samples alone
and taken from both, since they share the sensor. Errors are of single measurements against the map, per component and
of the vector; predictive sds hold the map's noise.

    python benchmarks/kok_walks.py [FOLDER]     or ISODYN_DATA/kok-1d; exits 1 unless bias terms help over all walks
"""

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from app.field.body_bias import estimate_body_bias, remove_body_bias
from app.field.fit import fit_map
from app.field.samples import Samples
from app.field.spec import MapSpec

WALKS = {"square": 0, "eight": 0, "library": 150, "mall": 0}  # samples to drop at the beginning
NEAR_M, APART_M = 0.7, 5.0
NOISES = ("white", "walk")


@dataclass(frozen=True)
class Errors:
    """Measured minus predicted (n, 3) and its predicted sd (n, 3)."""

    error_uT: np.ndarray
    sd_uT: np.ndarray

    @classmethod
    def joined(cls, parts: list["Errors"]) -> "Errors":
        return cls(np.concatenate([p.error_uT for p in parts]), np.concatenate([p.sd_uT for p in parts]))

    @property
    def vector_rmse_uT(self) -> float:
        return float(np.sqrt(np.mean(np.sum(np.square(self.error_uT), axis=1))))

    @property
    def coverage(self) -> float:
        """Of two sds, over all components."""
        return float(np.mean(np.abs(self.error_uT) <= 2.0 * self.sd_uT))

    @property
    def nlpd(self) -> float:
        z = self.error_uT / self.sd_uT
        return float(np.mean(np.log(self.sd_uT) + 0.5 * np.square(z) + 0.5 * np.log(2.0 * np.pi)))

    def __str__(self) -> str:
        rmse = np.sqrt(np.mean(np.square(self.error_uT), axis=0))
        robust = 1.4826 * np.median(np.abs(self.error_uT - np.median(self.error_uT, axis=0)), axis=0)
        by_component = " ".join(f"{value:5.2f}" for value in (*rmse, *robust))
        return f"{by_component} | {self.vector_rmse_uT:6.2f} {self.coverage:6.3f} {self.nlpd:6.2f}"


def read_walk(path: Path, dropped: int) -> Samples:
    """Body axes and attitude as the data set's own code has them: ZYX angles of `quat`, pitch and roll reversed."""
    columns = loadmat(path)
    position_m = columns["initPos"] + np.vstack([np.zeros(3), np.cumsum(columns["dPos"], axis=0)])
    yaw, pitch, roll = Rotation.from_quat(columns["quat"], scalar_first=True).as_euler("ZYX").T
    tilt = Rotation.from_euler("Y", -pitch[:, None]) * Rotation.from_euler("X", -roll[:, None])
    attitude = Rotation.from_euler("Z", yaw[:, None]) * tilt * Rotation.from_euler("Z", [-0.5 * np.pi])
    kept = slice(dropped, None)
    return Samples(
        t_s=columns["t"].ravel()[kept],
        p_building_m=position_m[kept],
        B_uT=attitude.apply(columns["m"])[kept],
        frame="building",
        q_body_to_building=attitude.as_quat(scalar_first=True)[kept],
    )


def first_visits(walk: Samples) -> tuple[np.ndarray, np.ndarray]:
    """(n,) mapped and asked: samples that come where nobody was before, and all others."""
    path_m = walk.path_length_m()
    pairs = np.sort(cKDTree(walk.p_building_m[:, :2]).query_pairs(NEAR_M, output_type="ndarray"), axis=1)
    again = np.zeros(len(walk), dtype=np.bool_)
    again[pairs[path_m[pairs[:, 1]] - path_m[pairs[:, 0]] > APART_M, 1]] = True
    return ~again, again


def halves(walk: Samples) -> tuple[np.ndarray, np.ndarray]:
    """(n,) mapped and asked: the first half of the path, and what of the second comes near it."""
    path_m = walk.path_length_m()
    mapped = path_m < 0.5 * path_m[-1]
    distance_m, _ = cKDTree(walk.p_building_m[mapped, :2]).query(walk.p_building_m[:, :2])
    return mapped, ~mapped & (distance_m < NEAR_M)


def chosen(walk: Samples, kept: np.ndarray) -> Samples:
    q = walk.q_body_to_building
    return Samples(walk.t_s[kept], walk.p_building_m[kept], walk.B_uT[kept], walk.frame, None if q is None else q[kept])


def errors_of(walk: Samples, mapped: np.ndarray, asked: np.ndarray, noise: str) -> Errors:
    """Without attitude, so that `fit_map` cannot take out a bias by itself."""
    plain = replace(walk, q_body_to_building=None)
    fitted = fit_map({"first": chosen(plain, mapped)}, MapSpec(noise=noise, hard_iron=False))
    values = fitted.grid.at(walk.p_building_m[asked])
    sd_uT = np.sqrt(np.square(values.sd_uT) + np.square(fitted.grid.noise_sd_uT))
    return Errors(walk.B_uT[asked] - values.mean_uT, sd_uT)


def variants(walk: Samples, mapped: np.ndarray, asked: np.ndarray) -> Iterator[tuple[tuple[str, bool], Errors]]:
    bias = estimate_body_bias(chosen(walk, mapped))
    assert bias is not None
    print(f"  bias {bias.bias_body_uT.round(2)}, sd {np.sqrt(np.diag(bias.covariance_uT2)).round(2)} uT")
    for corrected in (False, True):
        for noise in NOISES:
            found = errors_of(remove_body_bias(walk, bias) if corrected else walk, mapped, asked, noise)
            print(f"  {noise:5s} {'bias' if corrected else '':5s} {found}")
            yield (noise, corrected), found


def main() -> int:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else os.environ.get("ISODYN_DATA", "../shared/data") + "/kok-1d")
    if not (folder / "square.mat").exists():
        print(f"skipped: no walks in {folder}; get manonkok/1d-magnetic-field-slam and give its data folder")
        return 0
    passed = True
    for split in (first_visits, halves):
        total: dict[tuple[str, bool], list[Errors]] = {}
        for name, dropped in WALKS.items():
            walk = read_walk(folder / f"{name}.mat", dropped)
            mapped, asked = split(walk)
            print(f"{name}, {split.__name__}: {mapped.sum()} samples mapped, {asked.sum()} asked")
            print("              RMSE x, y, z      robust sd x, y, z | vector 2 sds   nlpd")
            for variant, errors in variants(walk, mapped, asked):
                total.setdefault(variant, []).append(errors)
        print(f"all walks, {split.__name__}")
        joined = {variant: Errors.joined(parts) for variant, parts in total.items()}
        for (noise, corrected), errors in joined.items():
            print(f"  {noise:5s} {'bias' if corrected else '':5s} {errors}")
        for noise in NOISES:
            ratio = joined[noise, True].vector_rmse_uT / joined[noise, False].vector_rmse_uT
            helps = ratio < 1.0 and joined[noise, True].nlpd < joined[noise, False].nlpd
            passed &= helps
            print(f"  {noise} noise: vector RMSE with bias over without {ratio:.3f}: {'PASS' if helps else 'FAIL'}")
    return 0 if passed else 1


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
