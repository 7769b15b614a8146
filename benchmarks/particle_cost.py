"""What one step of a particle filter costs: 10,000 particles, a map of three components.

A step moves the particles (heading and scale of each drifting), looks the map up (bilinear), weighs a reading, counts
the effective sample size and resamples systematically, every time. Compared in one process on one thread, in turns of
ten steps; the first of ten finds the caches cold:

    fused     `app.tracking.fused_step`: single precision, one compiled pass
    numpy     the same step in plain vectorised numpy, single and double precision
    particles the package of Nicolas Chopin, class SMC with a bootstrap model doing the same in double precision

The package is not among our dependencies since it pins an older numpy. To compare with it:

    pip install --no-deps particles==0.4
    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/particle_cost.py [--particles 10000] [--rounds 60]

Exits 1 when the fused step is not five times as fast as each of the others.
"""

import argparse
import sys
from collections.abc import Callable
from time import thread_time

import numpy as np
from scipy.ndimage import gaussian_filter
from threadpoolctl import threadpool_limits

from app.field.grid import FieldGrid
from app.tracking.cloud import CellTable, Cloud, Step, cell_table
from app.tracking.fused_step import step_fused
from app.tracking.motion import Displacement
from app.tracking.plain_step import step_plain

try:
    import particles
    import particles.resampling
    from particles.distributions import ProbDist
    from particles.state_space_models import Bootstrap, StateSpaceModel
except ImportError:
    particles = None

TARGET = 5.0
ALWAYS = 2.0  # resample below this share of n
IN_A_ROW = 10
STEP = Step((0.5, 0.1), (20.0, 4.0, -45.0), 1.0, Displacement())


def scene(n: int) -> tuple[Cloud, CellTable]:
    """A floor of 60 x 40 m in cells of 25 cm, and particles within two metres or so."""
    rng = np.random.default_rng(0)
    field = np.stack([gaussian_filter(rng.normal(size=(160, 240)), 6.0) for _ in range(3)], axis=-1)
    mean = (60.0 * field + [18.0, 3.0, -44.0]).astype(np.float32)[None]
    gradient, three = np.zeros((*mean.shape, 2), dtype=np.float32), np.ones(3)
    grid = FieldGrid(
        components="vector",
        origin_m=(0.0, 0.0),
        resolution_m=0.25,
        heights_m=np.zeros(1),
        mean_uT=mean,
        sd_uT=np.full_like(mean, 0.4),
        gradient_uT_per_m=gradient,
        measured=np.ones(mean.shape[:3], dtype=np.bool_),
        ambient_uT=three,
        prior_sd_uT=three,
        noise_sd_uT=three,
    )
    table, position = cell_table(grid), rng.normal([30.0, 20.0], 2.0, (n, 2))
    cloud = Cloud.of(position, rng.normal(0.0, 0.1, n), rng.normal(1.0, 0.03, n))
    return step_fused(cloud, table, STEP, 0, 0).cloud, table  # weights as they are after a step


def doubled(cloud: Cloud, table: CellTable) -> tuple[Cloud, CellTable]:
    """The same in double precision."""
    record, *numbers = table
    wide = CellTable(record.astype(np.float64), *map(np.float64, numbers))
    return Cloud(cloud.state.astype(np.float64), cloud.weight.astype(np.float64)), wide


def of_fused(cloud: Cloud, table: CellTable) -> Callable[[], object]:
    number = iter(range(10**9))
    return lambda: step_fused(cloud, table, STEP, next(number), 1, ALWAYS)


def of_numpy(cloud: Cloud, table: CellTable) -> Callable[[], object]:
    rng, n, dtype = np.random.default_rng(1), len(cloud), cloud.state.dtype
    return lambda: step_plain(cloud, table, STEP, rng.standard_normal((4, n), dtype=dtype), rng.random(), ALWAYS)


def of_package(cloud: Cloud, table: CellTable) -> Callable[[], object]:
    """SMC that has begun, put back to the cloud before each step; its state is (n, 4): x, y, heading, scale."""
    dx, dy = STEP.displacement_m
    position_sd, heading_sd, scale_sd = STEP.motion.sds(float(np.hypot(dx, dy)))
    sds = np.array([position_sd, position_sd, heading_sd, scale_sd])
    record, x0, y0, per_m = table
    ny, nx, _ = record.shape
    flat = record.reshape(-1, 4)

    class Moved(ProbDist):
        dim = 4

        def __init__(self, before):
            self.before = before

        def rvs(self, size=None):
            after = self.before + sds * np.random.standard_normal((size, 4))  # noqa: NPY002 - as the package draws
            c, s = np.cos(after[:, 2]), np.sin(after[:, 2])
            after[:, 0] += after[:, 3] * (c * dx - s * dy)
            after[:, 1] += after[:, 3] * (s * dx + c * dy)
            return after

    class Read(ProbDist):
        dim = 3

        def __init__(self, state):
            self.state = state

        def logpdf(self, reading):
            x, y, heading, _ = self.state.T
            u, v = np.clip((x - x0) * per_m, 0, nx - 1), np.clip((y - y0) * per_m, 0, ny - 1)
            i, j = np.minimum(u.astype(np.int64), nx - 2), np.minimum(v.astype(np.int64), ny - 2)
            fu, fv, place = u - i, v - j, j * nx + i
            shares = ((1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv)
            bx, by, bz, variance = found = np.zeros((4, len(u)))
            for offset, share in zip((0, 1, nx, nx + 1), shares, strict=True):
                corner = np.ascontiguousarray(flat.take(place + offset, axis=0).T)
                corner *= share
                found += corner
            c, s = np.cos(heading), np.sin(heading)
            bx -= c * reading[0] - s * reading[1]
            by -= s * reading[0] + c * reading[1]
            bz -= reading[2]
            variance += STEP.sensor_variance_uT2
            return -0.5 * ((bx * bx + by * by + bz * bz) / variance + 3.0 * np.log(variance))

    class Begun(ProbDist):
        dim = 4

        def rvs(self, size=None):
            x, y, c, s, scale = cloud.state
            return np.stack([x, y, np.arctan2(s, c), scale], axis=1)

    class Walk(StateSpaceModel):
        def PX0(self):
            return Begun()

        def PX(self, t, xp):
            return Moved(xp)

        def PY(self, t, xp, x):
            return Read(x)

    data = [np.array(STEP.reading_uT)] * 2
    smc = particles.SMC(fk=Bootstrap(ssm=Walk(), data=data), N=len(cloud), ESSrmin=1.0, collect="off")
    next(smc)
    begun, weights = smc.X, particles.resampling.Weights(lw=np.log(cloud.weight))

    def step() -> object:
        smc.t, smc.X, smc.wgts, smc.rs_flag = 1, begun, weights, False
        return next(smc)

    return step


def timed(steps: dict[str, Callable[[], object]], rounds: int) -> dict[str, np.ndarray]:
    """Processor time (rounds, IN_A_ROW) of each, s: steps in a row, in turns: a busy machine is then busy for all."""
    for step in steps.values():
        step()
    seconds = {name: np.empty((rounds, IN_A_ROW)) for name in steps}
    for k in range(rounds):
        for name, step in steps.items():
            for m in range(IN_A_ROW):
                started = thread_time()
                step()
                seconds[name][k, m] = thread_time() - started
    return seconds


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--particles", type=int, default=10_000)
    parser.add_argument("--rounds", type=int, default=60)
    asked = parser.parse_args()
    cloud, table = scene(asked.particles)
    wide = doubled(cloud, table)
    steps = {"fused": of_fused(cloud, table), "numpy, single": of_numpy(cloud, table), "numpy, double": of_numpy(*wide)}
    if particles is None:
        print("the package is missing: pip install --no-deps particles==0.4")
    else:
        steps["particles"] = of_package(*wide)
    seconds = timed(steps, asked.rounds)
    print(f"{asked.particles} particles, one step, median of {asked.rounds} times {IN_A_ROW} in a row")
    print(f"{'':15}{'us':>8}{'ns a particle':>15}{'times ours':>12}{'quartiles':>14}{'first of ten':>14}")
    ours, ratios = seconds["fused"], {}
    for name, each in seconds.items():
        ratios[name] = float(np.median(each) / np.median(ours))
        low, high = np.quantile(np.median(each, axis=1) / np.median(ours, axis=1), [0.25, 0.75])
        us, cold = 1e6 * float(np.median(each)), float(np.median(each[:, 0]) / np.median(ours[:, 0]))
        ns = 1e3 * us / asked.particles
        print(f"{name:15}{us:8.0f}{ns:15.1f}{ratios[name]:12.1f}{low:8.1f}-{high:<5.1f}{cold:14.1f}")
    missed = [name for name, ratio in ratios.items() if name != "fused" and ratio < TARGET]
    print(f"at least {TARGET:g} times as fast as each: " + ("MISSED by " + ", ".join(missed) if missed else "HOLDS"))
    return bool(missed)


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
