"""What Kuevor's dissertation found about tracking a drone by the map of a room, tried again in analytic rooms like his.

Four survey flights are fitted with the project's own engine; the steepest and the flattest point of the map, r*_max and
r*_min, are chosen as he does (B26); eight flights hover or stride in x, y, z there (B28).
The filter is his (B27): dead reckoning with a 200 Hz accelerometer, attitude known, a prior around the true start, a
constant R_mag, the box, resampling below 0.75 n with jitter. It runs with the magnetometer (20 Hz), an altimeter as
well (4 Hz), with the field's norm instead of the vector (B31), and with our likelihood, where R is the sensor's and the
map's variance; and, beside it, with ours (`app/tracking/inertial_particles.py`: velocity, accelerometer bias and offset
integrated per particle, errors alike along the way), told the sds of noise, bias and offset below. What the source does
not print of his was proposed before these flights and is not tuned here: 1 uT, jitter of 2 cm and 0.05 m/s, a prior of
5 cm and 0.05 m/s. Flights have no take-off and landing.

Noise: accelerometer 1.5 m/s^2 white per sample and a constant 0.05 m/s^2 (1 sd); magnetometer 0.12 uT white and a
constant 0.25 uT (1 sd) per flight; altimeter 3 cm, while the filter believes his 0.005 m^2.

    python benchmarks/kuevor_tracking.py [--rooms 1] [--repetitions 20] [--seconds 20] [--particles 500]
                                          [--engine hilbert|compromise|exact|truth] [--offset 0.25]
                                          [--settings mag "mag + alt" norm inertial "inertial + alt"]

Prints tables and a verdict for each relation; DISAGREES is a finding. Exits 1 when something could not be computed.
"""

import argparse
import sys
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from app.field.fit import fit_map
from app.field.grid import FieldGrid
from app.field.localizability import GlmSeries, glm, glm_average, glm_ratio_of_means, gradient_norms
from app.field.spec import MapSpec
from app.geometry import Array
from app.synthetic.room import (
    EPSILON_SCAN_M,
    GAMMA_SCAN_M,
    LOWER_FOUR_M,
    UPPER_FOUR_M,
    UTILIZATION_BOX_M,
    SyntheticRoom,
    box_grid_m,
    fly,
    make_room,
)
from app.tracking.constraints import Box, altimeter_log_likelihood
from app.tracking.error_attribution import attribute_error, windowed_misfit_uT
from app.tracking.field_likelihood import literal, log_likelihood, neutral, norm_of
from app.tracking.field_lookup import FieldTable, field_table, look_up
from app.tracking.inertial_particles import InertialMap, InertialModel, burst_of, inertial_map, new_particles, step
from app.tracking.motion import Accelerometer
from app.tracking.particle_filter import Particles, estimate, normalise, update

SURVEYS = (LOWER_FOUR_M, UPPER_FOUR_M, GAMMA_SCAN_M, EPSILON_SCAN_M)
NOISE_UT, OFFSET_UT = 0.12, 0.25
STEP_S, BURST, ALTIMETER_EVERY = 0.005, 10, 5  # 200 Hz; a reading every 10 steps; a height every 5 readings
WHITE_M_S2, BIAS_M_S2, ALTIMETER_M = 1.5, 0.05, 0.03
R_MAG_UT2, JITTER, PRIOR = 1.0, np.repeat([0.02, 0.05], 3), np.repeat([0.05, 0.05], 3)
CONSTRAINT = Box(np.array([-2.25, -1.75, 0.0]), np.array([2.25, 1.75, 2.5]))
HEIGHTS_M = tuple(float(h) for h in np.arange(0.0, 2.51, 0.125))
STRIDE_S = 4.5
Kind = Literal["hover", "x", "y", "z"]
KINDS: tuple[Kind, ...] = ("hover", "x", "y", "z")
POINTS = ("min", "max")
Setting = Literal["mag", "mag + alt", "norm", "norm + alt", "ours", "inertial", "inertial + alt"]
SETTINGS: tuple[Setting, ...] = ("mag", "mag + alt", "norm", "norm + alt", "ours", "inertial", "inertial + alt")
BY_DEFAULT: tuple[Setting, ...] = ("mag", "mag + alt", "norm", "inertial", "inertial + alt")
DEVICE = InertialModel(acceleration_m_s2=WHITE_M_S2, bias_m_s2=BIAS_M_S2, reading_uT=NOISE_UT, offset_uT=OFFSET_UT)
SEEDS = {  # Table 4.6 and 4.7: truncated norm RMSE, m (Kuevor, L1813-L1823, L2001-L2011)
    ("min", "hover"): (0.07, 0.07, 0.78, 0.28), ("max", "hover"): (0.04, 0.04, 2.56, 3.19),
    ("min", "x"): (0.10, 0.10, 1.32, 0.56), ("max", "x"): (0.42, 0.22, 0.96, 1.34),
    ("min", "y"): (0.16, 0.15, 1.51, 0.96), ("max", "y"): (0.09, 0.08, 1.06, 1.27),
    ("min", "z"): (0.17, 0.26, 0.55, 0.84), ("max", "z"): (0.08, 0.08, 1.30, 0.97),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Flight:
    """True positions (m, 3), readings (m, 3) and heights (m,) at times of readings; bursts (m, 10, 3) lead there."""

    point: str
    kind: Kind
    true_m: Array
    velocity_m_s: Array
    reading_uT: Array
    height_m: Array
    acceleration_m_s2: Array


class Run(NamedTuple):
    """Errors (m, 3) of the estimates, how often the particles diverged, and how often all left the box.

    nees: median over readings of the squared error in the filter's own covariance; 2.4 where that is right, else NaN.
    """

    error_m: Array
    diverged: int
    all_outside: int
    nees: float = np.nan


# ---- the flights


def centres(grid: FieldGrid) -> dict[str, Array]:
    """r*_min and r*_max of the map over 30 x 30 x 6 nodes of the box it is used in (Kuevor, L1652)."""
    nodes = box_grid_m(UTILIZATION_BOX_M, (30, 30, 6))
    total = gradient_norms(grid.at(nodes).gradient_uT_per_m).total
    return {"min": nodes[np.argmin(total)], "max": nodes[np.argmax(total)]}


def path_m(centre: Array, kind: Kind, t_s: Array, rng: np.random.Generator) -> Array:
    """(m, 3) from the centre, strides over the whole box along one axis, eased; all sway by two centimetres or so."""
    low, high = UTILIZATION_BOX_M
    frequency_hz, phase = rng.uniform(0.1, 0.6, (3, 4)), rng.uniform(0.0, 2.0 * np.pi, (3, 4))
    sway = np.sin(2.0 * np.pi * frequency_hz * t_s[:, None, None] + phase).sum(axis=2) * 0.015
    path = centre + sway * np.minimum(t_s / 2.0, 1.0)[:, None]
    if kind != "hover":
        axis = KINDS.index(kind) - 1
        ends = (low[axis] + 0.06, high[axis] - 0.06)
        number, part = np.divmod(t_s / STRIDE_S, 1.0)
        eased = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        start = np.where(number == 0, centre[axis], np.where(number % 2 == 1, ends[1], ends[0]))
        path[:, axis] += start + eased * (np.where(number % 2 == 0, ends[1], ends[0]) - start) - centre[axis]
    return path


def fly_through(
    room: SyntheticRoom, point: str, centre: Array, kind: Kind, asked: argparse.Namespace, seed: int
) -> Flight:
    """The log of a flight; accelerations are those whose semi-implicit sums give the path."""
    rng = np.random.default_rng(seed)
    readings = int(asked.seconds / STEP_S) // BURST
    t_s = STEP_S * np.arange(readings * BURST + 2)
    path = path_m(centre, kind, t_s, rng)
    velocity = np.diff(path, axis=0) / STEP_S
    acceleration = np.diff(velocity, axis=0) / STEP_S
    measured = acceleration + WHITE_M_S2 * rng.normal(size=acceleration.shape) + BIAS_M_S2 * rng.normal(size=3)
    true = path[1 + BURST :: BURST]
    field = room.field_uT(true) + asked.offset * rng.normal(size=3) + NOISE_UT * rng.normal(size=true.shape)
    height = true[:, 2] + ALTIMETER_M * rng.normal(size=len(true))
    return Flight(point, kind, true, velocity[0], field, height, measured.reshape(readings, BURST, 3))


# ---- the filter


def run(table: FieldTable, flight: Flight, setting: Setting, n: int, seed: int) -> Run:
    """One repetition; the box is tested at readings, between which ten steps are drawn at once."""
    rng, motion = np.random.default_rng(seed), Accelerometer()
    start = np.concatenate([flight.true_m[0] - BURST * STEP_S * flight.velocity_m_s, flight.velocity_m_s])
    particles = Particles.equal(start + PRIOR * rng.normal(size=(n, 6)))
    error, diverged, all_outside = np.empty_like(flight.true_m), 0, 0
    for k, burst in enumerate(flight.acceleration_m_s2):
        state = motion.propagate_burst(particles.state, burst, STEP_S, rng)
        boxed = CONSTRAINT.apply(state, particles.log_weight)
        log_l = reading_log_likelihood(table, boxed.state, boxed.log_weight, flight.reading_uT[k], setting)
        if setting.endswith("alt") and k % ALTIMETER_EVERY == 0:
            log_l = log_l + altimeter_log_likelihood(boxed.state[:, 2], flight.height_m[k])
        found = update(Particles(boxed.state, boxed.log_weight), log_l, rng, jitter_sd=JITTER)
        particles, diverged = found.particles, diverged + found.diverged
        all_outside += boxed.all_outside
        mean = found.estimate.mean if not boxed.all_outside else estimate_of(found.particles)
        error[k] = mean[:3] - flight.true_m[k]
    return Run(error, diverged, all_outside)


def run_inertial(the_map: InertialMap, flight: Flight, setting: Setting, n: int, seed: int) -> Run:
    """One repetition of ours, from the same prior."""
    rng = np.random.default_rng(seed)
    start = flight.true_m[0] - BURST * STEP_S * flight.velocity_m_s
    particles = new_particles(
        start + PRIOR[:3] * rng.normal(size=(n, 3)), flight.velocity_m_s, PRIOR[3], DEVICE, the_map
    )
    error, nees, diverged, all_outside = np.empty_like(flight.true_m), np.empty(len(flight.true_m)), 0, 0
    for k, samples in enumerate(flight.acceleration_m_s2):
        told = setting.endswith("alt") and k % ALTIMETER_EVERY == 0
        height, burst = float(flight.height_m[k]) if told else None, burst_of(samples, STEP_S, DEVICE)
        found = step(
            particles, burst, flight.reading_uT[k], the_map, DEVICE, rng, height_m=height, box=CONSTRAINT
        )  # fmt: skip
        particles, diverged, all_outside = found.particles, diverged + found.diverged, all_outside + found.all_outside
        error[k] = found.estimate.mean[:3] - flight.true_m[k]
        nees[k] = error[k] @ np.linalg.pinv(found.estimate.covariance[:3, :3]) @ error[k]
    return Run(error, diverged, all_outside, float(np.median(nees)))


def estimate_of(particles: Particles) -> Array:
    return estimate(particles.state, normalise(particles.log_weight).weight).mean


def reading_log_likelihood(table: FieldTable, state: Array, log_weight: Array, reading: Array, setting: str) -> Array:
    looked = look_up(table, state[:, :3])
    if setting.startswith("norm"):
        return literal(norm_of(looked), np.linalg.norm(reading, keepdims=True), R_MAG_UT2)
    if setting.startswith("ours"):
        log_l = log_likelihood(looked, reading, NOISE_UT**2 + 2.0 * OFFSET_UT**2)
        return neutral(log_l, looked.measured, log_weight)
    return literal(looked, reading, R_MAG_UT2)


def rmse(runs: list[Run]) -> Array:
    """(4,) of x, y, z and norm, the mean over repetitions (Kuevor, L1748)."""
    per_axis = np.array([np.sqrt(np.mean(np.square(each.error_m), axis=0)) for each in runs])
    return np.append(per_axis.mean(axis=0), np.linalg.norm(per_axis, axis=1).mean())


# ---- what became of it


def glm_of(grid: FieldGrid, flight: Flight) -> tuple[float, float]:
    """GLM_avg and the ratio of means along a flight."""
    t_s, series = BURST * STEP_S * np.arange(len(flight.true_m)), glm_along(grid, flight)
    return glm_average(t_s, series), glm_ratio_of_means(t_s, series)


def glm_along(grid: FieldGrid, flight: Flight) -> GlmSeries:
    values = grid.at(flight.true_m)
    return glm(values.gradient_uT_per_m, values.mean_uT - flight.reading_uT)


def attributions(grid: FieldGrid, flight: Flight, each: Run, seconds: float = 5.0) -> Counter:
    """Diagnoses of stretches of a repetition (Kuevor B29)."""
    found, length = Counter(), int(seconds / (STEP_S * BURST))
    for first in range(0, len(flight.true_m) - length + 1, length):
        inside = slice(first, first + length)
        truth, reading = grid.at(flight.true_m[inside]), flight.reading_uT[inside]
        at_estimate = grid.at(flight.true_m[inside] + each.error_m[inside]).mean_uT
        norms = gradient_norms(truth.gradient_uT_per_m)
        slope = np.array([norms.x.mean(), norms.y.mean(), norms.z.mean()])
        sd = np.sqrt(np.square(truth.sd_uT) + NOISE_UT**2 + 2.0 * OFFSET_UT**2)
        coverage = float(np.mean(np.abs(truth.mean_uT - reading) <= 2.0 * sd))
        error = np.sqrt(np.mean(np.square(each.error_m[inside]), axis=0))
        misfits = windowed_misfit_uT(at_estimate, reading), windowed_misfit_uT(truth.mean_uT, reading)
        found[attribute_error(error, *misfits, slope, coverage)] += 1
    return found


def true_map(room: SyntheticRoom) -> FieldGrid:
    """The room's own field on the same cells: what a perfect survey would give."""
    x_m, y_m = np.arange(-2.8, 2.85, 0.1), np.arange(-2.3, 2.35, 0.1)
    z, y, x = np.meshgrid(HEIGHTS_M, y_m, x_m, indexing="ij")
    cells = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    slopes = [(room.field_uT(cells + step) - room.field_uT(cells - step)) / 2e-3 for step in 1e-3 * np.eye(3)]
    mean = room.field_uT(cells).reshape(*x.shape, 3).astype(np.float32)
    return FieldGrid(
        components="vector",
        origin_m=(-2.8, -2.3),
        resolution_m=0.1,
        heights_m=np.array(HEIGHTS_M),
        mean_uT=mean,
        sd_uT=np.full_like(mean, 0.02),
        gradient_uT_per_m=np.stack(slopes, axis=-1).reshape(*mean.shape, 3).astype(np.float32),
        measured=np.ones(x.shape, dtype=np.bool_),
        ambient_uT=mean.mean(axis=(0, 1, 2)).astype(np.float64),
        prior_sd_uT=np.full(3, 5.0),
        noise_sd_uT=np.full(3, NOISE_UT),
    )


def fitted(room: SyntheticRoom, seed: int, engine: str) -> FieldGrid:
    """A map of four survey flights, or the truth."""
    if engine == "truth":
        return true_map(room)
    rng = np.random.default_rng(seed)
    walks = {
        f"{k}": fly(room, altitudes, rng, noise_uT=NOISE_UT, offset_sd_uT=OFFSET_UT)
        for k, altitudes in enumerate(SURVEYS)
    }
    spec = MapSpec(
        engine=engine,  # type: ignore[arg-type]
        kernel="squared_exponential",
        resolution_m=0.1,
        heights_m=HEIGHTS_M,
        noise="white",
        hard_iron=False,
    )
    return fit_map(walks, spec).grid


def by_gradient(gradient: Array, squared_m2: Array) -> str:
    """RMS errors of the readings in each range of the true gradient's norm; his room has 5.6 to 22 uT/m (B26)."""
    edges, cells = (0.0, 1.0, 3.0, 5.6, 10.0, np.inf), []
    for low, high in pairwise(edges):
        inside = (gradient >= low) & (gradient < high)
        if inside.any():
            cells.append(f"{low:g}-{high:g} uT/m {np.sqrt(squared_m2[inside].mean()):.2f} m ({inside.mean():.0%})")
    return ", ".join(cells)


def verdict(claim: str, holds: bool, figure: str) -> None:
    print(f"{'AGREES' if holds else 'DISAGREES':10} {claim}: {figure}")


def verdicts(table: dict[tuple[str, Kind, Setting], Array], glms: dict[tuple[str, Kind], tuple[float, float]]) -> None:
    """Relations of one room, of the settings that were flown."""
    flights = [(p, k) for p in POINTS for k in KINDS]
    of = {s: {f: float(table[*f, s][3]) for f in flights} for s in SETTINGS if (*flights[0], s) in table}
    for name in ("", "+ alt"):
        for setting in (f"mag {name}".strip(), f"inertial {name}".strip()):
            if setting in of:
                within_verdicts(setting, of[setting], 6 if name else 7)
    for index, name in enumerate(("GLM_avg", "ratio of means")):
        low, steep = ([glms[p, k][index] for k in KINDS] for p in POINTS)
        verdict(f"{name} ranks r*_min below r*_max (L1973)", max(low) < min(steep), f"{show(low)} < {show(steep)}")
    for setting in ("mag", "inertial"):
        if setting in of:
            ranks = [np.argsort(np.argsort([each[f] for f in flights])) for each in (ratios(glms), of[setting])]
            correlation = float(np.corrcoef(*ranks)[0, 1])
            verdict(
                f"{setting}: larger GLM goes with lower error (L1926)", correlation < 0.0, f"rank {correlation:.2f}"
            )
            if f"{setting} + alt" in of:
                altimeter_verdict(setting, of[setting], of[f"{setting} + alt"])
    if "mag" in of:
        worst = [np.argmax(table[*f, "mag"][:3]) == 0 for f in flights]
        verdict("x is the worst axis (L1798)", sum(worst) > 4, f"in {sum(worst)} of 8")
    for setting in ("ours", "inertial"):
        if {"mag", setting} <= set(of):
            wins = sum(of[setting][f] < of["mag"][f] for f in flights)
            verdict(f"{setting} beats the source's filter in most flights", wins > 4, f"{wins} of 8")
    if {"mag", "norm"} <= set(of):
        ratio = [of["norm"][f] / of["mag"][f] for f in flights]
        figure = f"{min(ratio):.1f} to {max(ratio):.1f} times, mean {np.mean(ratio):.1f}"
        verdict("norm only is worse in every flight (R17: 2.3 to 64 times)", min(ratio) > 1.0, figure)
    if {"norm", "norm + alt"} <= set(of):
        harmed = sum(of["norm + alt"][f] > of["norm"][f] for f in flights)
        verdict("altimeter worsens some flights by norm (L1999: 4)", harmed > 0, f"{harmed} of 8")


def within_verdicts(setting: str, of: dict[tuple[str, Kind], float], least: int) -> None:
    """The headlines: 0.2 m where the field is steep, and in how many of eight."""
    high = [of["max", k] for k in KINDS]
    verdict(f"{setting}: at most 0.2 m in flights of high gradient (5.4)", max(high) <= 0.2, show(high))
    count = sum(v <= 0.2 for v in of.values())
    verdict(f"{setting}: at most 0.2 m in {least} of eight (L1975)", count >= least, f"{count}")
    better = sum(of["max", k] < of["min", k] for k in KINDS)
    verdict(f"{setting}: r*_max better than r*_min in three of four kinds (L1827)", better >= 3, f"{better} of 4")


def altimeter_verdict(setting: str, mag: dict[tuple[str, Kind], float], alt: dict[tuple[str, Kind], float]) -> None:
    gains = [sum(alt[f] < mag[f] - 0.005 for f in mag), sum(alt[f] > mag[f] + 0.005 for f in mag)]
    claim = f"{setting}: altimeter helps more flights than it harms (L1876: 3 and 1)"
    verdict(claim, gains[0] > gains[1], f"{gains[0]}, {gains[1]}")


def ratios(glms: dict[tuple[str, Kind], tuple[float, float]]) -> dict[tuple[str, Kind], float]:
    return {flight: each[1] for flight, each in glms.items()}


def show(numbers: list[float]) -> str:
    return " ".join(f"{number:.2f}" for number in numbers)


def room_study(seed: int, asked: argparse.Namespace) -> bool:
    """Tables and verdicts of a room; whether all figures are finite."""
    room = make_room(np.random.default_rng(seed))
    grid = fitted(room, seed, asked.engine)
    lookup, inertial, points = field_table(grid), inertial_map(grid), centres(grid)
    blind = {name: np.linalg.svd(grid.at(p).gradient_uT_per_m[0])[1][-1] for name, p in points.items()}
    places = ", ".join(
        f"r*_{name} {np.round(p, 2)} {gradient_norms(grid.at(p).gradient_uT_per_m).total[0]:.2f} uT/m, "
        f"{blind[name]:.2f} in the blindest direction"
        for name, p in points.items()
    )
    print(f"\nroom {seed}: {places}")
    names = "".join(f"{s:>26}" for s in asked.settings)
    print(f"RMSE, m: norm (x y z)\n{'flight':11}{names}   GLM_avg  ratio   source (mag, + alt, norm, + alt)")
    table, glms, why, steep, missed, nees = {}, {}, Counter(), [], [], []
    for kind in KINDS:
        for point, centre in points.items():
            flight = fly_through(room, point, centre, kind, asked, 1000 * seed + KINDS.index(kind))
            glms[point, kind] = glm_of(grid, flight)
            cells = []
            for setting in asked.settings:
                runs = (
                    [run_inertial(inertial, flight, setting, asked.particles, r) for r in range(asked.repetitions)]
                    if setting.startswith("inertial")
                    else [run(lookup, flight, setting, asked.particles, r) for r in range(asked.repetitions)]
                )
                nees += [each.nees for each in runs if setting.startswith("inertial")]
                table[point, kind, setting] = x, y, z, norm = rmse(runs)
                lost = sum(each.diverged for each in runs)
                cells.append(f"{norm:.2f} ({x:.2f} {y:.2f} {z:.2f}){'!' if lost else ' '}")
                if setting == "mag":
                    steep.append(room.gradient_norm_uT_per_m(flight.true_m))
                    missed.append(np.mean([np.sum(np.square(each.error_m), axis=1) for each in runs], axis=0))
                    for each in runs:
                        why += attributions(grid, flight, each)
            average, ratio = glms[point, kind]
            print(
                f"{point} {kind:7}"
                + "".join(f"{c:>26}" for c in cells)
                + f"{average:10.2f}{ratio:7.2f}   {SEEDS[point, kind]}",
                flush=True,
            )
    if nees:
        low, middle, high = np.quantile(nees, [0.1, 0.5, 0.9])
        print(
            f"inertial: median squared error in its own covariance (right: 2.4): {middle:.1f} ({low:.1f} to {high:.1f})"
        )
    if why:
        tell_why(why, np.concatenate(steep), np.concatenate(missed))
    verdicts(table, glms)
    return all(np.isfinite(values).all() for values in table.values())


def tell_why(why: Counter, steep_uT_per_m: Array, missed_m2: Array) -> None:
    """Diagnoses and errors by gradient of the source's filter by magnetometer."""
    stretches = ", ".join(f"{name} {count / sum(why.values()):.0%}" for name, count in why.most_common())
    print(f"stretches of 5 s, magnetometer (B29): {stretches}")
    print("magnetometer, by the gradient where it is: " + by_gradient(steep_uT_per_m, missed_m2))


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--rooms", type=int, nargs="+", default=[1])
    parser.add_argument("--repetitions", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--offset", type=float, default=OFFSET_UT, help="of the flights that are tracked, uT")
    parser.add_argument("--engine", choices=["hilbert", "compromise", "exact", "truth"], default="hilbert")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=BY_DEFAULT)
    asked = parser.parse_args()
    finite = [room_study(seed, asked) for seed in asked.rooms]
    return 0 if all(finite) else 1


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
