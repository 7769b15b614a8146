"""How often an answer, and how good: the trade-off of MLR, ABL and the posterior that Shockley left open (L1528).

Windows of 2, 3, 5 and 10 m on unseen walks in the analytic buildings of `calibration.py`, their maps fitted from
surveys, by another sensor with errors of its own; level, the same demeaned (as of a sensor of unknown offset), or as
norms; heading unknown, every floor a candidate. Each is matched once, and then answered by

    MLR          the most likely pose, sure by its likelihood ratio to the best one at least 1, 2, 5, 10 or 20 m away
    ABL          the mean of the heaviest bin of 0.5, 1, 2 or 4 m, sure by the largest share of a cell over the uniform
    ABL, mass    the same place, sure by the share of that bin
    posterior    its position, sure by the probability of its strongest mode (off the map and missed mass counted in)
    ... mapped   the same, taking for granted that the window was walked where there is a map
    radius       its position, sure by how small its 95 % radius is

A threshold on the sureness withholds answers: availability is the share of windows answered, accuracy the share of the
answered that end on the right floor within 1 m (3 m) of the truth (Shockley 8.9). Standard errors and those of
differences come from resampling the windows.

Which of them is more accurate than MLR when 50, 80 and 95 % of the windows are answered is a finding, not a target.

    python benchmarks/availability.py --picture docs/pictures/availability.png
                      exits 1 unless of the windows that `locate` calls a fix 95 % are within 1 m, of every kind
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from calibration import ASKER, SPACING_M, surveyed_map, with_hard_iron
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from app.geometry import Array
from app.positioning import belief as believing
from app.positioning.belief import Belief, believe
from app.positioning.estimates import abl_estimate, mlr_estimate
from app.positioning.fix import LocateOptions
from app.positioning.floors import SearchableFloor, reduce_floor
from app.positioning.locate import prepare_floors, warm_up
from app.positioning.matching import Matched, match
from app.positioning.verdict import conclude
from app.positioning.window import Composition, Window, WindowFrame
from app.synthetic.building import SyntheticBuilding, make_building
from app.synthetic.sensors import Pose, window
from app.synthetic.walks import random_waypoints

LENGTHS_M = (2.0, 3.0, 5.0, 10.0)
DISTANCES_M, BINS_M = (1.0, 2.0, 5.0, 10.0, 20.0), (0.5, 1.0, 2.0, 4.0)
RATIOS = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 30.0, 100.0, 1e3, 1e4, 1e5, 1e6)
MULTIPLES = (1.0, 10.0, 30.0, 100.0, 300.0, 1e3, 3e3, 1e4, 3e4, 1e5)
SHARES = (0.0, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99, 0.999)
RADII_M = (100.0, 30.0, 10.0, 5.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5)
AVAILABILITIES = (0.5, 0.8, 0.95)
NEAR_M, NEARISH_M = 1.0, 3.0
RELIABLE = 0.95  # so many answers should be within NEAR_M
DRAWS = 300
DEFAULTS = LocateOptions()


class Kind(NamedTuple):
    """How windows are asked."""

    frame: WindowFrame
    composition: Composition

    def __str__(self) -> str:
        return self.frame if self.composition == "raw" else self.composition


KINDS = (Kind("level", "raw"), Kind("level", "demeaned"), Kind("norm", "raw"))


@dataclass(frozen=True, slots=True)
class Technique:
    """What answers, by which parameter, and the thresholds of its sureness that are swept."""

    name: str
    thresholds: tuple[float, ...]
    unit: str
    parameter_m: float | None = None
    smaller_is_surer: bool = False

    def __str__(self) -> str:
        return self.name if self.parameter_m is None else f"{self.name} {self.parameter_m:g} m"

    def reaches(self, value: Array, threshold: float) -> NDArray[np.bool_]:
        return np.asarray(value <= threshold if self.smaller_is_surer else value >= threshold)


MLR = tuple(Technique("MLR", RATIOS, "ratio", d) for d in DISTANCES_M)
ABL = tuple(Technique("ABL", MULTIPLES, "x uniform", b) for b in BINS_M)
ABL_MASS = tuple(Technique("ABL, mass", SHARES, "of the mass", b) for b in BINS_M)
POSTERIOR = Technique("posterior", SHARES, "probability")
MAPPED = Technique("... mapped", SHARES, "probability")
RADIUS = Technique("radius", RADII_M, "m", smaller_is_surer=True)
TECHNIQUES = (*MLR, *ABL, *ABL_MASS, POSTERIOR, MAPPED, RADIUS)
DEFAULT_MLR = next(t for t in MLR if t.parameter_m == DEFAULTS.mlr_min_distance_m)
DEFAULT_ABL = next(t for t in ABL_MASS if t.parameter_m == DEFAULTS.abl_bin_m)
COMPARED = (DEFAULT_MLR, DEFAULT_ABL, POSTERIOR, MAPPED, RADIUS)


@dataclass(frozen=True, slots=True, eq=False)
class Answered:
    """Windows of one kind: per technique how sure each answer was, and how far off (inf: on another floor)."""

    kind: Kind
    length_m: float | None  # None: all lengths
    sure: dict[Technique, Array]
    error_m: dict[Technique, Array]
    is_fix: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.is_fix)

    def __str__(self) -> str:
        return f"{self.kind} " + ("all" if self.length_m is None else f"{self.length_m:g} m")


@dataclass(slots=True)
class Rows:
    """Answers as they come, before they are `Answered`."""

    sure: dict[Technique, list[float]] = field(default_factory=lambda: {t: [] for t in TECHNIQUES})
    error_m: dict[Technique, list[float]] = field(default_factory=lambda: {t: [] for t in TECHNIQUES})
    is_fix: list[bool] = field(default_factory=list)


# ---- windows


def answer_all_ways(
    asked: Window, pose: Pose, floors: Sequence[SearchableFloor], composition: Composition, rows: Rows
) -> None:
    """Match once; the techniques' other parameters are answered from the same match."""
    sweeping = replace(DEFAULTS, mlr_ratio=RATIOS[-1], abl_min_probability=0.0)
    matched = match(asked, floors, floors[0].components, composition, None, sweeping)
    belief = believe(matched)
    fix = conclude(matched, belief, ("ml", "mlr", "abl"), sweeping)
    posterior, ml = fix.posterior, fix.ml
    assert posterior is not None
    assert ml is not None

    def tell(technique: Technique, sure: float | None, floor_id: str | None, place: Sequence[float] | None) -> None:
        assert sure is not None
        assert place is not None
        off = np.linalg.norm(np.array(place[:2]) - pose.position_m[:2])
        rows.sure[technique].append(sure)
        rows.error_m[technique].append(float(off) if floor_id == str(pose.floor) else np.inf)

    for technique, ratio in ratios(matched, belief).items():
        tell(technique, ratio, ml.floor_id, ml.position_m)
    for by_peak, by_mass in zip(ABL, ABL_MASS, strict=True):
        assert by_peak.parameter_m is not None
        abl = abl_estimate(matched, belief, replace(sweeping, abl_bin_m=by_peak.parameter_m))
        tell(by_peak, abl.peak_over_uniform, abl.floor_id, abl.position_m)
        tell(by_mass, abl.bin_probability, abl.floor_id, abl.position_m)
    unweighed = 0.0 if matched.candidates.complete else posterior.missed_probability
    strongest = posterior.modes[0].probability * (1.0 - posterior.off_map_probability) * (1.0 - unweighed)
    tell(POSTERIOR, strongest, posterior.floor_id, posterior.position_m)
    tell(MAPPED, posterior.modes[0].probability, posterior.floor_id, posterior.position_m)
    tell(RADIUS, posterior.radius_95_m, posterior.floor_id, posterior.position_m)
    rows.is_fix.append(fix.status == "fix")


def ratios(matched: Matched, known: Belief) -> dict[Technique, float]:
    """Of the best pose and the best one so far from it, for every distance; zero: the map ends before.

    What `believe` does for the one distance it is asked for. Never more than was searched for: where no rival was
    found, all that is known is that it is as much.
    """
    optima = believing.find_optima(matched, believing.pose_gaussian(matched))
    found = {}
    for technique in MLR:
        assert technique.parameter_m is not None
        options = replace(matched.options, mlr_min_distance_m=technique.parameter_m)
        belief = replace(known, log_ratio=believing.log_ratio(optima, technique.parameter_m))
        found[technique] = min(mlr_estimate(matched, belief, options).ratio or 0.0, RATIOS[-1])
    return found


def answer_windows(
    building: SyntheticBuilding,
    floors: Sequence[SearchableFloor],
    count: int,
    kind: Kind,
    length_m: float,
    rng: np.random.Generator,
) -> Answered:
    """`count` windows of one kind, each of a walk and a sensor of its own."""
    ready = [reduce_floor(floor, "norm" if kind.frame == "norm" else "vector") for floor in floors]
    rows = Rows()
    for _ in range(count):
        walk = random_waypoints(building, int(rng.integers(len(floors))), rng, length_m=max(20.0, 2.0 * length_m))
        samples = int(length_m / SPACING_M) + 1
        sensor = with_hard_iron(ASKER, rng)
        asked, pose = window(building, walk, sensor, rng, length_m=length_m, samples=samples, frame=kind.frame)
        answer_all_ways(asked, pose, ready, kind.composition, rows)
    sure = {t: np.array(values) for t, values in rows.sure.items()}
    error_m = {t: np.array(values) for t, values in rows.error_m.items()}
    return Answered(kind, length_m, sure, error_m, np.array(rows.is_fix))


def pooled(parts: Sequence[Answered]) -> Answered:
    """Windows of several buildings, or of several lengths."""
    lengths = {part.length_m for part in parts}
    sure = {t: np.concatenate([part.sure[t] for part in parts]) for t in TECHNIQUES}
    error_m = {t: np.concatenate([part.error_m[t] for part in parts]) for t in TECHNIQUES}
    is_fix = np.concatenate([part.is_fix for part in parts])
    return Answered(parts[0].kind, lengths.pop() if len(lengths) == 1 else None, sure, error_m, is_fix)


# ---- figures


def answered_weights(sure: Array, availability: float) -> Array:
    """(n,) which windows are answered when so many are: the surest; of the equally sure an even share each."""
    wanted = availability * len(sure)
    threshold = np.sort(sure)[len(sure) - max(int(np.ceil(wanted - 1e-9)), 1)]
    weight = (sure > threshold).astype(np.float64)
    tied = sure == threshold
    weight[tied] = (wanted - weight.sum()) / tied.sum()
    return np.asarray(weight)


def accuracy_at(
    answered: Answered, technique: Technique, availability: float, chosen: NDArray[np.int64] | None = None
) -> float:
    """Share of the answers within NEAR_M when that share of the windows (all, or those `chosen`) is answered."""
    sure, error_m = answered.sure[technique], answered.error_m[technique]
    if chosen is not None:
        sure, error_m = sure[chosen], error_m[chosen]
    weight = answered_weights(-sure if technique.smaller_is_surer else sure, availability)
    return float(weight @ (error_m <= NEAR_M) / weight.sum())


def resampled(count: int) -> Iterator[NDArray[np.int64]]:
    """The same draws of windows every time."""
    rng = np.random.default_rng(1)
    for _ in range(DRAWS):
        yield rng.integers(count, size=count)


def difference(answered: Answered, a: Technique, b: Technique, availability: float) -> tuple[float, float]:
    """How much more accurate a is than b when both answer that share, and its standard error."""

    def apart(chosen: NDArray[np.int64] | None = None) -> float:
        return accuracy_at(answered, a, availability, chosen) - accuracy_at(answered, b, availability, chosen)

    return apart(), float(np.std([apart(chosen) for chosen in resampled(len(answered))]))


def share(values: NDArray[np.bool_]) -> tuple[float, float]:
    """A share and its standard error; of no values, nan."""
    if not len(values):
        return np.nan, np.nan
    p = float(np.mean(values))
    return p, float(np.sqrt(p * (1.0 - p) / len(values)))


def told(*figures: tuple[float, float]) -> str:
    return "    ".join(f"{value:.3f} ± {error:.3f}" for value, error in figures)


def report_curve(answered: Answered, technique: Technique) -> None:
    """Availability against accuracy, threshold by threshold."""
    error_m = answered.error_m[technique]
    print(f"{answered}, {technique}    n = {len(answered)}")
    print("    threshold                available       within 1 m       within 3 m    error median / 95 %")
    for threshold in technique.thresholds:
        given = technique.reaches(answered.sure[technique], threshold)
        off_m = error_m[given]
        figures = told(share(given), share(off_m <= NEAR_M), share(off_m <= NEARISH_M))
        median, most = np.quantile(off_m, [0.5, 0.95], method="inverted_cdf") if len(off_m) else (np.nan, np.nan)
        print(f"    {threshold:9g} {technique.unit:12s} {figures}     {median:.2f} / {most:.2f} m")


def report_equal(answered: Answered, techniques: Sequence[Technique]) -> None:
    """The techniques when they answer the same share of the windows."""
    for technique in techniques:
        cells = []
        for availability in AVAILABILITIES:
            drawn = [accuracy_at(answered, technique, availability, chosen) for chosen in resampled(len(answered))]
            cells.append((accuracy_at(answered, technique, availability), float(np.std(drawn))))
        print(f"{answered!s:13s} {technique!s:15s}  {told(*cells)}")


def report_against_mlr(answered: Answered) -> bool:
    """Print who is more accurate than MLR at equal availability; whether ABL or the posterior never is less so."""
    never_less = True
    for availability in AVAILABILITIES:
        cells, words = [], []
        for technique in COMPARED[1:]:
            value, error = difference(answered, technique, DEFAULT_MLR, availability)
            margin = 2.0 * error + 1e-9
            words.append("better" if value > margin else "worse" if value < -margin else "no different")
            cells.append(f"{technique} {100 * value:+.1f} ± {100 * error:.1f} ({words[-1]})")
        never_less &= words[:2] != ["worse", "worse"]
        print(f"{answered!s:13s} {100 * availability:3.0f} % answered: " + ", ".join(cells))
    return never_less


def report_least(answered: Answered, technique: Technique) -> None:
    """The least threshold of the sweep from which on RELIABLE of the answers are within NEAR_M, and what it leaves."""
    near = answered.error_m[technique] <= NEAR_M
    best = None
    for threshold in reversed(technique.thresholds):  # the strictest first
        given = technique.reaches(answered.sure[technique], threshold)
        if given.any() and np.mean(near[given]) < RELIABLE:
            break
        best = (threshold, given) if given.any() else best
    if best is None:
        print(f"{answered!s:13s} {technique!s:15s}     none")
    else:
        threshold, given = best
        print(
            f"{answered!s:13s} {technique!s:15s} {threshold:9g} {technique.unit:12s} "
            f"{told(share(given), share(near[given]))}"
        )


def report_shipped(answered: Answered) -> bool:
    """What the defaults of `locate` do: MLR and ABL as they answer, and the status "fix"; whether that is reliable."""
    rules = {
        f"MLR > {DEFAULTS.mlr_ratio:g}": (answered.sure[DEFAULT_MLR] > DEFAULTS.mlr_ratio, DEFAULT_MLR),
        f"ABL >= {DEFAULTS.abl_min_probability:g}": (
            answered.sure[DEFAULT_ABL] >= DEFAULTS.abl_min_probability,
            DEFAULT_ABL,
        ),
        "status fix": (answered.is_fix, POSTERIOR),
    }
    for name, (given, technique) in rules.items():
        print(f"{answered!s:13s} {name:15s}  {told(share(given), share(answered.error_m[technique][given] <= NEAR_M))}")
    fixed_m = answered.error_m[POSTERIOR][answered.is_fix]
    return not len(fixed_m) or float(np.mean(fixed_m <= NEAR_M)) >= RELIABLE


# ---- picture


def draw(parts: Sequence[Answered], path: Path) -> None:
    """Share of the answers within 1 m against the share of the windows answered, a panel per kind of window."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    colours = ("#D55E00", "#0072B2", "#000000", "#CC79A7", "#009E73")
    lines = ("-", "--", "-.", "-", ":")
    kinds = [kind for kind in KINDS if any(part.kind == kind for part in parts)]
    figure = Figure(figsize=(10.0, 2.6 * len(kinds) + 0.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(kinds), len(LENGTHS_M), sharex=True, sharey=True, squeeze=False)
    at = np.linspace(0.05, 1.0, 96)
    for part in (part for part in parts if part.length_m is not None):
        ax = axes[kinds.index(part.kind)][LENGTHS_M.index(part.length_m)]
        for technique, colour, line in zip(COMPARED, colours, lines, strict=True):
            curve = 100.0 * np.array([accuracy_at(part, technique, availability) for availability in at])
            ax.plot(100.0 * at, curve, line, color=colour, label=str(technique), linewidth=1.5)
        ax.set_title(f"{part}, {len(part)} windows", fontsize=9)
        ax.grid(alpha=0.3)
    for row in axes:
        row[0].set_ylabel("answers within 1 m, %")
    for ax in axes[-1]:
        ax.set_xlabel("windows answered, %")
    handles, names = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(names), fontsize=9, frameon=False)
    figure.savefig(path, dpi=90)


def report(parts: Sequence[Answered], every_parameter: bool) -> int:
    """Print all tables; 1 if fixes are not reliable."""
    kinds = [kind for kind in KINDS if any(part.kind == kind for part in parts)]
    whole = [pooled([part for part in parts if part.kind == kind]) for kind in kinds]
    for answered in (*parts, *whole):
        for technique in TECHNIQUES if answered.length_m is None or every_parameter else COMPARED:
            report_curve(answered, technique)
    print(f"\nwithin {NEAR_M:g} m when answered are     50 %             80 %             95 %")
    for answered in (*parts, *whole):
        report_equal(answered, TECHNIQUES if answered.length_m is None or every_parameter else COMPARED)
    print(
        f"\nleast threshold from which on {100 * RELIABLE:.0f} % of the answers are within {NEAR_M:g} m: available, "
        f"within {NEAR_M:g} m"
    )
    for answered in (*parts, *whole):
        for technique in TECHNIQUES if answered.length_m is None or every_parameter else COMPARED:
            report_least(answered, technique)
    print(f"\nmore accurate than {DEFAULT_MLR}, points of the share within {NEAR_M:g} m")
    for answered in parts:
        report_against_mlr(answered)
    never_less = [report_against_mlr(answered) for answered in whole]
    print(f"ABL or the posterior always at least as accurate as MLR: {'yes' if all(never_less) else 'no'} (a finding)")
    print(f"\nas shipped: available, within {NEAR_M:g} m")
    for answered in parts:
        report_shipped(answered)
    reliable = [report_shipped(answered) for answered in whole]
    passed = all(reliable)
    print(f"a fix is within {NEAR_M:g} m in {100 * RELIABLE:.0f} % of every kind  {'PASS' if passed else 'FAIL'}")
    return 0 if passed else 1


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--windows", type=int, default=60, help="level ones of each length and building")
    parser.add_argument("--ambiguous", type=int, default=15, help="demeaned ones and norms, which take much longer")
    parser.add_argument("--buildings", type=int, default=2)
    parser.add_argument("--floors", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--every-parameter", action="store_true", help="print the curves of all distances and bins")
    parser.add_argument("--picture", type=Path, help="draw the curves to this PNG")
    given = parser.parse_args()
    warm_up()
    found: dict[tuple[Kind, float], list[Answered]] = {}
    for number in range(given.buildings):
        rng = np.random.default_rng([given.seed, number])
        building = make_building(rng, floors=given.floors)
        floors = prepare_floors({str(k): surveyed_map(building, k, rng) for k in range(given.floors)})
        for k, kind in enumerate(KINDS):
            count = given.windows if kind == KINDS[0] else given.ambiguous
            for length_m in LENGTHS_M if count else ():
                rng = np.random.default_rng([given.seed, number, k, round(10.0 * length_m)])
                part = answer_windows(building, floors, count, kind, length_m, rng)
                found.setdefault((kind, length_m), []).append(part)
    parts = [pooled(each) for each in found.values()]
    if given.picture is not None:
        draw(parts, given.picture)
    return report(parts, given.every_parameter)


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
