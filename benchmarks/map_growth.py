"""How the cost of a map grows, with samples on one area and with area at one density; and what one more survey costs.

Samples of a random smooth field (a sum of waves) on lawnmower walks of 5,000 samples each, noise 0.5 uT, everything
fit_map does: learning, tiles, leave-one-survey-out, consistency, layers.

    python benchmarks/map_growth.py         exits 1 when an exponent is above 1.1, memory above 2 GiB, or the update
                                            of the largest map by one survey above 5 % of its fit, or not the same map
"""

import resource
import sys
import time
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from app.field.fit import fit_map
from app.field.samples import Samples
from app.field.spec import FittedMap, MapSpec

SPEC = MapSpec(kernel="matern32", resolution_m=0.5)
SURVEY_SAMPLES = 5_000
AREA_M2 = 10_000.0
DENSITY_PER_M2 = 20.0
SAMPLES = (10_000, 30_000, 100_000, 300_000, 1_000_000)
AREAS_M2 = (1_000.0, 3_000.0, 10_000.0, 20_000.0)
EXPONENT, MEMORY_GIB, UPDATE = 1.1, 2.0, 0.05


class Waves:
    """A field with a correlation length of a few metres, known everywhere."""

    def __init__(self, rng: np.random.Generator, waves: int = 60) -> None:
        self._k = rng.normal(0.0, 0.7, (waves, 2))
        self._phase = rng.uniform(0.0, 2.0 * np.pi, waves)
        self._amplitude = 5.0 * np.sqrt(2.0 / waves) * rng.choice([-1.0, 1.0], (waves, 3))

    def field_uT(self, points_m: np.ndarray) -> np.ndarray:
        return np.array([20.0, 5.0, -40.0]) + np.cos(points_m[:, :2] @ self._k.T + self._phase) @ self._amplitude


def lawnmower(
    rng: np.random.Generator, waves: Waves, corner_m: np.ndarray, side_m: np.ndarray, samples: int
) -> Samples:
    """A walk of `samples` in lanes over a rectangle, evenly spaced, a random way round."""
    lanes = max(2, int(np.sqrt(samples / 40.0)))
    each = int(np.ceil(samples / lanes))
    u = np.linspace(0.0, 1.0, each)
    unit = np.concatenate(
        [
            np.column_stack([u if k % 2 == 0 else u[::-1], np.full(each, (k + rng.random()) / lanes)])
            for k in range(lanes)
        ]
    )[:samples]
    if rng.random() < 0.5:
        unit = unit[:, ::-1]
    p = np.column_stack([corner_m + unit * side_m, np.full(len(unit), 1.2)])
    return Samples(0.02 * np.arange(len(p)), p, waves.field_uT(p) + rng.normal(0.0, 0.5, (len(p), 3)), "building")


def surveys(samples: int, area_m2: float, first: int = 0) -> dict[str, Samples]:
    """As many surveys of SURVEY_SAMPLES as make up `samples`, each over a patch; together about the whole square."""
    rng = np.random.default_rng([7, first])
    waves = Waves(np.random.default_rng(7))
    count, side = samples // SURVEY_SAMPLES, np.sqrt(area_m2)
    patch = side * min(1.0, np.sqrt(4.0 / count))
    return {
        f"{first + k:06d}": lawnmower(rng, waves, rng.uniform(0.0, side - patch, 2), np.full(2, patch), SURVEY_SAMPLES)
        for k in range(count)
    }


def timed(walks: dict[str, Samples], previous=None) -> tuple[float, FittedMap]:
    start = time.process_time()
    fitted = fit_map(walks, SPEC, previous=previous)
    return time.process_time() - start, fitted


def exponent(sizes: tuple[float, ...], times_s: list[float]) -> float:
    """Of the power law through the larger half, where what is constant no longer shows."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(times_s[half:]), 1)[0])


def main() -> int:
    timed(surveys(10_000, 200.0))  # compiles
    ok, times_s = True, []
    for samples in SAMPLES:
        walks = surveys(samples, AREA_M2)
        elapsed_s, fitted = timed(walks)
        times_s.append(elapsed_s)
        print(
            f"{samples:9,d} samples on {AREA_M2:,.0f} m2: {elapsed_s:7.2f} s, {len(fitted.state.tiles)} tiles",
            flush=True,
        )
    full_s, whole = times_s[-1], fitted
    grown = exponent(SAMPLES, times_s)
    steepest = max(np.diff(np.log(times_s)) / np.diff(np.log(SAMPLES)))
    print(f"exponent with samples {grown:.2f}, steepest step {steepest:.2f}")
    ok &= grown <= EXPONENT
    memory_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {memory_gib:.2f} GiB")
    ok &= memory_gib <= MEMORY_GIB

    for what, side_m in (("a patch of 12 x 12 m", 12.0), ("a patch of 25 x 25 m", 25.0)):
        rng = np.random.default_rng(99)
        more = lawnmower(
            rng, Waves(np.random.default_rng(7)), np.array([40.0, 40.0]), np.full(2, side_m), SURVEY_SAMPLES
        )
        added_s, added = timed(walks | {"zz": more}, whole.state)
        print(
            f"one more survey of {SURVEY_SAMPLES:,} samples, {what}: {added_s:.2f} s = {added_s / full_s:.1%} of the"
            f" fit, {added.tiles_refitted} of {len(added.state.tiles)} tiles", flush=True,
        )  # fmt: skip
        if side_m == 12.0:
            ok &= added_s <= UPDATE * full_s
            refit = timed(walks | {"zz": more}, replace(whole.state, tiles={}))[1]
            difference = np.abs(added.grid.mean_uT - refit.grid.mean_uT).max() / np.abs(refit.grid.mean_uT).max()
            print(f"largest difference from a refit {difference:.1e} of the field")
            ok &= difference <= 1e-6
    del walks, whole, added, refit, fitted

    times_s = []
    for area_m2 in AREAS_M2:
        elapsed_s, _ = timed(surveys(int(area_m2 * DENSITY_PER_M2), area_m2))
        times_s.append(elapsed_s)
        print(f"{area_m2:7,.0f} m2 at {DENSITY_PER_M2:.0f} samples per m2: {elapsed_s:7.2f} s", flush=True)
    grown = exponent(AREAS_M2, times_s)
    steepest = max(np.diff(np.log(times_s)) / np.diff(np.log(AREAS_M2)))
    print(f"exponent with area {grown:.2f}, steepest step {steepest:.2f}")
    ok &= grown <= EXPONENT
    print("PASS" if ok else "FAIL")
    return 0 if ok else 1


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
