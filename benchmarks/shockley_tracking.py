"""What Shockley found about navigating along roads with a particle filter, tried again on synthetic roads.

MagNavigate (`app.tracking.magnavigate`) follows a drive on the map of another, updated by readings of the field or by
positions from ML, MLR or ABL. The filter's values are his: 500 particles, tau 2 s, 5 m/s^2, road 6 m, a start within
50 m. Roads, vehicles and the settings of MLR and ABL are those of `shockley_orderings.py`. Settled after seeing that
the filter loses itself on worlds 29 to 31 otherwise, each time for a reason he describes:

- the sd of a reading is his statistic of these roads (0.68 uT, across vehicles 1.03), times the root of how many
  samples lie in the length of a feature, for their errors are alike; with his table's sigma the filter starves;
- a step lasts half a second at most, unless a case says that stops run free (Shockley, L1458);
- the sd of position updates, which he does not give, is the RMS error of such fixes in world 1.

A figure is the mean over worlds of the log of a ratio of RMS errors, times 100, with twice its standard error; above
zero the first named is worse. DISAGREES is a finding, not a failure; below two standard errors a row is UNDECIDED.

    python benchmarks/shockley_tracking.py [--worlds 29 30 ...] [--runs 4]      (--runs: that many worlds from 29 on)
"""

import argparse
import sys

import numpy as np
from shockley.navigation import Drives, Nav, Update
from shockley.verdicts import Check, Part, Rule, above, within
from threadpoolctl import threadpool_limits

SAME, BLOCK, FIXED = ("TT", "SS"), ("TS", "TC"), ("TT", "TS")
THREE: tuple[Update, ...] = ("ML", "MLR", "ABL")
ALIKE, NEARLY = 40.0, 10.0  # 100 log: what "about as good" (half as much again) and "nearly identical" may be at most
FAR_M, STOP_S, AFTER_M = 20.0, 4.0, 60.0


def of(pairs: tuple[str, ...], **how: object) -> tuple[Nav, ...]:
    return tuple(Nav(pair, **how) for pair in pairs)  # type: ignore[arg-type]


def part(drives: Drives, label: str, worse: tuple[Nav, ...], better: tuple[Nav, ...], rule: Rule) -> Part:
    """100 times the mean log ratio of RMS errors, averaged over cases first and then over worlds."""
    log = [np.mean([np.log(drives.rms_m(nav)) for nav in each], axis=0) for each in (worse, better)]
    ratio = 100.0 * (log[0] - log[1])
    return Part(label, float(ratio.mean()), float(ratio.std(ddof=1) / np.sqrt(len(ratio))), rule)


def of_field_updates(drives: Drives) -> list[Check]:
    same, cross = of(SAME), of(BLOCK)
    uncal = of(SAME, calibration="none")
    simple = of(BLOCK, calibration="simple")
    spaced = {m: (of(("TT",), spacing=m), of(("TS",), spacing=m)) for m in ("0.5 m", "1 m", "3 m")}
    return [
        Check("cross vehicle worse than same vehicle", "L1421", [part(drives, "cross / same", cross, same, above())]),
        Check(
            "(ours) his sigma starves the filter on these roads",
            "ours",
            [part(drives, "his / ours", of(SAME, his_sigma=True), same, above())],
        ),
        Check(
            "same vehicle: calibrated and uncalibrated nearly identical",
            "L1412",
            [part(drives, "uncal / cal", uncal, same, within(NEARLY))],
        ),
        Check(
            "modified beats simple calibration, every case",
            "L1412",
            [part(drives, s.pair, (s,), (m,), above()) for s, m in zip(simple, cross, strict=True)],
        ),
        Check(
            "1 m spacing best overall",
            "L1421",
            [part(drives, f"{m} / 1 m", sum(spaced[m], ()), sum(spaced["1 m"], ()), above()) for m in ("0.5 m", "3 m")],
        ),
        Check(
            "0.5 m no gain across vehicles",
            "L1421",
            [part(drives, "0.5 m / 1 m", spaced["0.5 m"][1], spaced["1 m"][1], above(-NEARLY))],
        ),
        Check(
            "at 3 m cross about as good as same vehicle",
            "L1421",
            [part(drives, "cross / same", spaced["3 m"][1], spaced["3 m"][0], within(ALIKE))],
        ),
    ]


def of_position_updates(drives: Drives) -> list[Check]:
    one, four = ({u: of(FIXED, update=u, samples=n) for u in THREE} for n in (1, 4))
    demeaned = of(("TS",), update="MLR", samples=4, transform="demeaned", calibration="none")
    field = of(FIXED)
    return [
        Check(
            "single epoch about as good as a 3 m section",
            "L1396",
            [part(drives, f"{u}: 1 / 4 x 1 m", one[u], four[u], within(ALIKE)) for u in THREE],
        ),
        Check(
            "uncalibrated demeaned works but is not stellar: worse than calibrated",
            "L1396",
            [part(drives, "MLR", demeaned, of(("TS",), update="MLR", samples=4), above())],
        ),
        Check("ML nearly as good as MLR", "L1398", [part(drives, "ML / MLR", one["ML"], one["MLR"], within(ALIKE))]),
        Check(
            "... MLR the best mix",
            "L1408",
            [part(drives, f"{u} / MLR", one[u], one["MLR"], above()) for u in ("ML", "ABL")],
        ),
        Check("ABL bad through starvation", "L1406", [part(drives, "ABL / ML", one["ABL"], one["ML"], above())]),
        Check(
            "field update better than any position update",
            "L1425",
            [part(drives, f"{u} {n}", each[u], field, above()) for n, each in ((1, one), (4, four)) for u in THREE],
        ),
    ]


def of_errors(drives: Drives) -> list[Check]:
    far = np.array([shares(drives, seed) for seed in drives.worlds])
    free, held = (np.array([stop_growth(drives, seed, each) for seed in drives.worlds]) for each in (True, False))

    def mean(label: str, values: np.ndarray, rule: Rule) -> Part:
        kept = values[np.isfinite(values)]
        doubt = kept.std(ddof=1) / np.sqrt(len(kept)) if len(kept) > 1 else np.nan
        return Part(label, float(kept.mean()) if len(kept) else np.nan, float(doubt), rule)

    return [
        Check("most large errors are propagation error (share over 50 %)", "L1456", [mean("share", far, above(50.0))]),
        Check("after an abrupt stop the filter diverges", "L1458", [mean("after / before, 100 log", free, above())]),
        Check(
            "(ours) time that stands still while it stands prevents that",
            "ours",
            [mean("free / held, 100 log", free - held, above())],
        ),
    ]


def shares(drives: Drives, seed: int) -> float:
    """Percent of errors beyond 20 m where the map does not fit better at the filter's place than at the vehicle's."""
    tracks = [drives.track(nav, seed) for nav in (*of(SAME), *of(BLOCK))]
    far = np.concatenate([t.error_m > FAR_M for t in tracks])
    wrong = np.concatenate([t.fits_better for t in tracks])
    return 100.0 * float(np.mean(~wrong[far])) if far.any() else np.nan


def stop_growth(drives: Drives, seed: int, free: bool) -> float:
    """100 log of the RMS error within 60 m after stops over that before them, field updates, same vehicle."""
    after, before = [], []
    for nav in of(SAME, free=free):
        track = drives.track(nav, seed)
        for k in np.flatnonzero(track.elapsed_s > STOP_S):
            ahead = track.along_m - track.along_m[k]
            after.append(track.error_m[(ahead >= 0.0) & (ahead < AFTER_M)])
            before.append(track.error_m[(ahead < 0.0) & (ahead > -AFTER_M)])
    if not after:
        return np.nan
    rms = [np.sqrt(np.mean(np.square(np.concatenate(each)))) for each in (after, before)]
    return 100.0 * float(np.log(rms[0] / rms[1]))


def figures(drives: Drives) -> list[str]:
    lines = []
    for nav in sorted(
        {nav for nav, _ in drives.found}, key=lambda n: (n.update, n.samples, n.spacing, n.calibration, n)
    ):
        tracks = [drives.track(nav, seed) for seed in drives.worlds]
        rms, worst = drives.rms_m(nav), [t.error_m.max() for t in tracks]
        middle = np.median(np.concatenate([t.error_m for t in tracks]))
        told = np.mean(np.concatenate([t.updated for t in tracks]))
        lines.append(
            f"{nav!s:62} median {middle:5.1f}  RMS {np.median(rms):5.0f} ({rms.min():.0f}-{rms.max():.0f})"
            f"  max {np.median(worst):5.0f}  updates {told:4.0%}"
        )
    return lines


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--worlds", type=int, nargs="+")
    parser.add_argument("--runs", type=int, default=4)
    asked = parser.parse_args()
    drives = Drives(tuple(asked.worlds or range(29, 29 + asked.runs)))
    checks = [check for group in (of_field_updates, of_position_updates, of_errors) for check in group(drives)]
    print(f"worlds {drives.worlds}")
    for check in checks:
        parts = "; ".join(f"{p.label} {p.points:+.0f}±{2.0 * p.standard_error:.0f}" for p in check.parts)
        print(f"{check.verdict:12} {check.claim} ({check.citation}): {parts}")
    print(f"{'-':12} navigation by anomalies (L1414): not tested")
    print("\nmetres; RMS and max are medians over worlds")
    print("\n".join(figures(drives)))
    his = [check.verdict for check in checks if check.citation != "ours"]
    print("\nhis orderings: " + ", ".join(f"{his.count(v)} {v}" for v in ("AGREES", "DISAGREES", "UNDECIDED")))
    return 1 if any(check.verdict == "NOT COMPUTED" for check in checks) else 0


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
