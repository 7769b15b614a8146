"""Calibrations of known sensors: Shockley's simulation, where its fit breaks down, Kuevor's sensor, honest covariances.

Each figure is printed beside its target or the source's.

1. Shockley's Monte-Carlo (12.1): a field of [200, -21, 493] mG, three level turns, 2500 readings, noise of 2 mG. The
   source gives no ranges: scales are uniform in 0.8-1.2, distortion in +-0.05, biases in +-130 mG. Errors are estimate
   less truth, of the entries of the correction A and of the bias.
2. The table of (Shockley, 3.6): the source's fit near rho = 1, beside the conic's.
3. Kuevor's Table 3.1 as truth (R2): 2000 orientations, 0.1 uT, and with a phone's hard iron of 300 uT. Angles within
   0.01 degrees, always, would take 13,000 readings: their sd is that, whatever the method.
4. (estimate - truth)^T C^-1 (estimate - truth) of every method: mean over its degrees of freedom, and the share beyond
   the 95 % point of its chi-square.

    python benchmarks/magnetometer_calibration.py --runs 1000      exits 1 unless all targets are met
"""

import argparse
import sys
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm
from threadpoolctl import threadpool_limits

from app.calibration.ellipsoid import ellipsoid
from app.calibration.fit import CalibrationFit
from app.calibration.map_aided import map_aided
from app.calibration.modified_ellipsoid import modified_ellipsoid
from app.calibration.norm_fit import symmetric_start
from app.calibration.strict_ellipse import strict_ellipse
from app.calibration.swinging import swinging
from app.calibration.two_step import distortion, two_step
from app.errors import InvalidInput

NORTH_UT, EAST_UT, Z_UT = 20.0, -2.1, 49.3
H_UT = float(np.hypot(NORTH_UT, EAST_UT))
NOISE_UT, SAMPLES, TURNS = 0.2, 2500, 3.0
MG = 10.0  # per uT
SCALE, DISTORTION, BIAS_UT = 0.2, 0.05, 13.0
B_R_UT = 53.1351
TABLE_3_1 = np.array([1.01, 0.955, 0.942, -1.26, -2.46, 3.24, *np.deg2rad([0.182, 2.28, -0.118])])
NAMES = ("hard_iron_x_ut", "hard_iron_y_ut", "correction_xx", "correction_yy", "correction_xy")
WAYS: dict[str, Callable[[np.ndarray], CalibrationFit]] = {
    "swinging": lambda B: swinging(B, H_UT, Z_UT, extremes="plain"),
    "swinging, unbiased": lambda B: swinging(B, H_UT, Z_UT),
    "swinging, literal": lambda B: swinging(B, H_UT, Z_UT, literal=True, north_uT=NORTH_UT),
    "strict ellipse": lambda B: strict_ellipse(B, H_UT, Z_UT),
    "modified, printed alpha": lambda B: modified_ellipsoid(B, H_UT, Z_UT, fit="shockley", alpha="printed"),
    "modified, alpha on Q": lambda B: modified_ellipsoid(B, H_UT, Z_UT, fit="shockley"),
    "modified, conic": lambda B: modified_ellipsoid(B, H_UT, Z_UT),
}
SOURCE = {
    "swinging": "-0.0771 ± 0.0276  -0.0761 ± 0.0275                    0.00 ± 0.00  0.00 ± 0.00",
    "strict ellipse": "+0.3929 ± 0.7357  +0.3890 ± 0.7221  +0.0278 ± 0.0660  0.09 ± 3.69  0.17 ± 4.11",
    "modified, alpha on Q": "+0.0139 ± 0.0243  +0.0137 ± 0.0241  -0.0106 ± 0.0285  0.09 ± 3.69  0.17 ± 4.11",
}


def turned(A: np.ndarray, b: np.ndarray, rng: np.random.Generator, noise_uT: float = NOISE_UT) -> np.ndarray:
    """(SAMPLES, 3) readings of a sensor that is turned level."""
    angle = np.linspace(0.0, 2 * np.pi * TURNS, SAMPLES, endpoint=False)
    true = H_UT * np.column_stack([np.cos(angle), -np.sin(angle)])
    level = np.column_stack([true @ np.linalg.inv(A).T + b, np.full(SAMPLES, Z_UT)])
    return level + noise_uT * rng.normal(size=level.shape)


def all_around(n: int, rng: np.random.Generator) -> np.ndarray:
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def said(ok: bool) -> str:
    return "PASS" if ok else "FAIL"


def shockley(runs: int, rng: np.random.Generator) -> bool:
    """The Monte-Carlo of Tables 3.1 and 3.2."""
    errors: dict[str, list[np.ndarray]] = {name: [] for name in WAYS}
    refused = dict.fromkeys(WAYS, 0)
    for _ in range(runs):
        A = np.diag(rng.uniform(1 - SCALE, 1 + SCALE, 2))
        A[0, 1] = A[1, 0] = rng.uniform(-DISTORTION, DISTORTION)
        b = rng.uniform(-BIAS_UT, BIAS_UT, 2)
        B = turned(A, b, rng)
        truth = symmetric_start(A, b)
        for name, fit in WAYS.items():
            try:
                found = fit(B).parameters
            except InvalidInput:
                refused[name] += 1
                errors[name].append(np.full(5, np.nan))
                continue
            errors[name].append(np.array([found.get(each, np.nan) for each in NAMES]) - truth)
    print(f"1. Shockley's simulation, {runs} runs: mean ± sd, then the median of |error|")
    print("                         scale x           scale y           distortion        bias x, y (mG)")
    median = {}
    for name in WAYS:
        e = np.array(errors[name])
        e = np.where(np.all(np.isnan(e), axis=0), 0.0, e)
        mean, sd = np.nanmean(e, axis=0), np.nanstd(e, axis=0)
        shown = [f"{mean[k]:+.4f} ± {sd[k]:.4f}" if sd[k] > 0.0 else " " * 16 for k in (2, 3, 4)]
        bias = [f"{MG * mean[k]:.2f} ± {MG * sd[k]:.2f}" for k in (0, 1)]
        median[name] = np.nanmedian(np.abs(e), axis=0)
        median[name][0] = np.nanmedian(np.hypot(e[:, 0], e[:, 1]))
        print(f"{name:24s} {'  '.join(shown + bias)}   refused {refused[name]}")
        x, y = median[name][2:4]
        print(f"{'':24s} median |scale| {x:.5f}, {y:.5f}, |bias| {MG * median[name][0]:.3f} mG")
        if name in SOURCE:
            print(f"{'  the source':24s} {SOURCE[name]}")
    strict, mod = np.array(errors["strict ellipse"]), np.array(errors["modified, alpha on Q"])
    both = np.isfinite(strict[:, 0]) & np.isfinite(mod[:, 0])
    # the source's order is of means, over sensors whose ellipse holds the origin; where it does not, strict says no
    order = [np.abs([np.nanmean(np.array(errors[n])[both, k]) for n in ("modified, alpha on Q", "swinging",
             "strict ellipse")]) for k in (2, 3)]  # fmt: skip
    checks = {
        "mean |modified| < |swinging| < |strict|, both scales": all(o[0] < o[1] < o[2] for o in order),
        "modified and strict share their bias": bool(np.array_equal(strict[both, :2], mod[both, :2])),
        "conic: median bias error at most 0.1 mG": MG * median["modified, conic"][0] <= 0.1,
        "conic: scale error a tenth of swinging's": bool(
            np.all(10 * median["modified, conic"][2:4] <= median["swinging"][2:4])
        ),
        "printed alpha comes out low": float(np.nanmean(np.array(errors["modified, printed alpha"])[both, 2])) < -0.05,
    }
    for what, ok in checks.items():
        print(f"   {what}: {said(ok)}")
    return all(checks.values())


def breakdown(rng: np.random.Generator, trials: int = 60) -> bool:
    """The table of (Shockley, 3.6)."""
    A = np.array([[1.08, 0.06], [0.06, 0.93]])
    printed = {0.0: (0.0006, 0.07), 0.5: (0.0010, 0.13), 0.9: (0.0062, 0.72), 0.97: (0.021, 2.5), 0.99: (0.062, 7.7),
               1.0: (0.60, 97.0), 1.1: (0.0068, 0.78), 3.0: (0.0007, 0.10)}  # fmt: skip
    print("2. rho, median of max|A - A_true| and of the bias error (mG): k = 0 fit [expected], conic")
    good = True
    for rho, expected in printed.items():
        b = np.array([H_UT * np.sqrt(rho) / np.linalg.norm(A[:, 0]), 0.0])
        found: dict[str, list[tuple[float, float]]] = {"shockley": [], "conic": []}
        refused = 0
        for _ in range(trials):
            B = turned(A, b, rng)
            for fit, errors in found.items():
                try:
                    model = modified_ellipsoid(B, H_UT, Z_UT, fit=fit).model  # type: ignore[arg-type]
                except InvalidInput:
                    refused += 1
                    continue
                off = float(np.abs(model.correction[:2, :2] - A).max())
                errors.append((off, MG * float(np.linalg.norm(model.hard_iron_uT[:2] - b))))
        k0, conic = (np.median(found[fit] or [(np.nan, np.nan)], axis=0) for fit in ("shockley", "conic"))
        good &= bool(conic[0] <= 0.0006 and conic[1] <= 0.1)
        said_no = f"   k = 0 refused {refused} of {trials}" if refused else ""
        print(f"   {rho:4.2f}   {k0[0]:.4f} [{expected[0]:.4f}]  {k0[1]:6.2f} [{expected[1]:6.2f}]"
              f"   {conic[0]:.4f}  {conic[1]:.3f}{said_no}")  # fmt: skip
    print(f"   conic within 0.0006 and 0.1 mG everywhere: {said(good)}")
    return good


def kuevor(runs: int, rng: np.random.Generator) -> bool:
    """Table 3.1 recovered: which share of seeds is within the targets, and what the sds say it must be."""
    good = True
    for label, b in (("Table 3.1", TABLE_3_1[3:6]), ("hard iron 300 uT", np.array([220.0, -140.0, 150.0]))):
        truth = TABLE_3_1.copy()
        truth[3:6] = b
        error, sd = [], []
        for _ in range(runs):
            B = B_R_UT * all_around(2000, rng) @ distortion(truth).T + b + 0.1 * rng.normal(size=(2000, 3))
            fit = two_step(B, B_R_UT)
            error.append(np.abs(np.array(list(fit.parameters.values())) - truth))
            sd.append(list(fit.parameter_sd.values()))
        e, s = np.array(error), np.median(sd, axis=0)
        print(f"3. {label}, {runs} seeds: worst of three, 50 / 95 / 100 %, [sd], target, share within")
        for what, k, target, unit in (
            ("scale", slice(0, 3), 0.001, 1.0), ("bias, uT", slice(3, 6), 0.02, 1.0),
            ("angle, deg", slice(6, 9), 0.01, np.rad2deg(1.0)),
        ):  # fmt: skip
            worst = unit * e[:, k].max(axis=1)
            within = float(np.mean(worst <= target))
            each = float(np.mean(unit * e[:, k] <= target))
            q = np.quantile(worst, [0.5, 0.95, 1.0])
            print(f"   {what:10s} {q[0]:.5f} / {q[1]:.5f} / {q[2]:.5f}  [{unit * s[k].max():.5f}]  {target}"
                  f"  all three {100 * within:.1f} %, each {100 * each:.1f} %")  # fmt: skip
            if what != "angle, deg":
                good &= within >= 0.99
                continue
            bound = float(np.mean(2.0 * norm.cdf(target / (unit * s[k])) - 1.0))
            verdict = "met" if within >= 0.99 else "MISSED"
            print(f"   {what:10s} within {target} in 99 % of seeds: {verdict}; sds at the "
                  f"bound of the readings' information allow each in {100 * bound:.1f} %")  # fmt: skip
            good &= abs(each - bound) < 0.05
    print(f"   scales and biases in 99 % of seeds, angles as often as their information allows: {said(good)}")
    return good


def covariances(runs: int, rng: np.random.Generator) -> bool:
    """Every method's squared errors over its covariance."""
    A = np.diag([1.08, 0.93])
    A3 = np.array([[1.05, 0.03, -0.02], [0.03, 0.97, 0.04], [-0.02, 0.04, 1.1]])
    b = np.array([4.0, -6.0, 8.0])
    full = np.array([[1.08, 0.06], [0.06, 0.93]])
    cases: dict[str, tuple[Callable[[], CalibrationFit], Callable[[], np.ndarray]]] = {}
    drawn: dict[str, np.ndarray] = {}

    def walk() -> CalibrationFit:
        drawn["theta"] = np.concatenate(
            [30.0 * rng.normal(size=3), (np.eye(3) + 0.1 * rng.normal(size=(3, 3))).ravel()]
        )
        return walked(drawn["theta"], rng)

    level = np.append([5.5, -7.0], 0.0)
    cases["swinging"] = (lambda: swinging(turned(A, level[:2], rng), H_UT, Z_UT),
                         lambda: np.array([5.5, -7.0, 1.08, 0.93, 0.0]))  # fmt: skip
    cases["modified_ellipsoid"] = (lambda: modified_ellipsoid(turned(full, level[:2], rng), H_UT, Z_UT),
                                   lambda: np.append(symmetric_start(full, level[:2]), 0.0))  # fmt: skip
    for noise_uT in (0.1, 2.0):

        def sphere(M: np.ndarray, h: np.ndarray, noise_uT: float = noise_uT) -> np.ndarray:
            return B_R_UT * all_around(1000, rng) @ M.T + h + noise_uT * rng.normal(size=(1000, 3))

        cases[f"ellipsoid, {noise_uT} uT"] = (
            lambda sphere=sphere: ellipsoid(sphere(np.linalg.inv(A3), b), B_R_UT),  # type: ignore[misc]
            lambda: symmetric_start(A3, b),
        )  # fmt: skip
        cases[f"two_step, {noise_uT} uT"] = (
            lambda sphere=sphere: two_step(sphere(distortion(TABLE_3_1), TABLE_3_1[3:6]), B_R_UT),  # type: ignore[misc]
            lambda: TABLE_3_1,
        )  # fmt: skip
    cases["map_aided"] = (walk, lambda: drawn["theta"])
    print(f"4. Squared errors over the covariance, {runs} runs: mean over degrees of freedom, share beyond 95 %")
    good = True
    for name, (fit, truth) in cases.items():
        squared = []
        for _ in range(runs):
            found = fit()
            e = np.array(list(found.parameters.values())) - truth()
            squared.append(float(e @ np.linalg.solve(found.covariance, e)))
        k = len(e)
        ratio, beyond = float(np.mean(squared)) / k, float(np.mean(np.array(squared) > chi2.ppf(0.95, k)))
        band = chi2.ppf([0.005, 0.995], k * runs) / (k * runs)
        ok = bool(band[0] <= ratio <= band[1])
        near = 0.9 <= ratio <= 1.15
        good &= near
        print(f"   {name:20s} {ratio:.3f}  (99 % band {band[0]:.3f}-{band[1]:.3f}: {'in' if ok else 'out'})"
              f"   {100 * beyond:.1f} %  {said(near)}")  # fmt: skip
    print("   target: within 0.9-1.15")
    return good


def walked(theta: np.ndarray, rng: np.random.Generator) -> CalibrationFit:
    """A walk of 60 m with tilts, on a map that errs by 0.8 uT over 3 m."""
    n, step_m, sd = 400, 0.15, 0.8
    path = step_m * np.arange(n)
    tilt = 0.5 * np.sin(np.arange(n) / 20)
    yaw = np.cumsum(0.15 * rng.normal(size=n))
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt, tilt[::-1]])).as_matrix()
    wave = np.column_stack([np.sin(path), np.cos(0.7 * path), np.sin(0.5 * path + 1)])
    B_map = np.array([18.0, 3.0, -42.0]) + 5.0 * wave
    lasting, keep = rng.normal(size=(n, 3)), np.exp(-step_m / 3.0)
    for i in range(1, n):
        lasting[i] = keep * lasting[i - 1] + np.sqrt(1 - keep**2) * lasting[i]
    body = np.einsum("nji,nj->ni", R, B_map + sd * lasting)
    reading = body @ theta[3:].reshape(3, 3).T + theta[:3] + 0.4 * rng.normal(size=(n, 3))
    return map_aided(reading, R, B_map, np.full((n, 3), sd**2), path_m=path)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    passed = [
        shockley(given.runs, rng), breakdown(rng), kuevor(max(50, given.runs // 2), rng),
        covariances(max(50, given.runs // 2), rng),
    ]  # fmt: skip
    return int(not all(passed))


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
