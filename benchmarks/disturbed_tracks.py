"""A trolley passes somebody who is followed: what the test for disturbed readings is worth.

Walks of 48 m through an analytic hall, readings and reckoning with noise, a field passing within five seconds. The
same tracker with the test, and with all readings believed.

    python benchmarks/disturbed_tracks.py --walks 8     exits 1 unless, from 10 uT on, the largest error while it passes
                                                           is less than a fifth of that without the test, and nothing
                                                           is called disturbed on clean walks
"""

import argparse
import sys

import numpy as np
from threadpoolctl import threadpool_limits

import app.tracking.track as tracking
from app.field.grid import FieldGrid
from app.positioning.floors import prepare_floor
from app.synthetic.hall import HALL_CORNERS_M, hall_map, hall_uT
from app.tracking.options import TrackOptions
from app.tracking.step import Step
from app.tracking.track import begin, follow, make_tracker

SIZES_UT = (0.0, 5.0, 10.0, 20.0, 40.0)
WITHIN = 0.2


def walk(grid: FieldGrid, size_uT: float, seed: int) -> tuple[float, float, float]:
    """Largest error while it passes, and the share of steps called disturbed then, and at other times."""
    n = 480
    tracker = make_tracker([prepare_floor("hall", grid)], "level", TrackOptions(particles=2000, noise_uT=0.3), 7)
    t = 0.1 * np.arange(n)
    legs = np.linalg.norm(np.diff(HALL_CORNERS_M, axis=0), axis=1)
    p = np.stack([np.interp(t, np.r_[0, np.cumsum(legs)], HALL_CORNERS_M[:, k]) for k in (0, 1)], axis=1)
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    passing = np.exp(-0.5 * ((t - 25.0) / 1.25) ** 2)[:, None] * size_uT * direction / np.linalg.norm(direction)
    B = hall_uT(p[:, 0], p[:, 1]) + rng.normal(0, 0.3, (n, 3)) + passing
    reckoned = p - p[0] + np.cumsum(rng.normal(0, 0.01, (n, 2)), axis=0)
    state, error, disturbed = begin(), np.full(n, np.nan), np.zeros(n, dtype=bool)
    for k in range(n):
        followed = follow(tracker, state, Step(k, float(t[k]), B[k], np.append(reckoned[k], 0.0), yaw_rad=0.0))
        state = followed.state
        disturbed[k] = state.disturbed
        if followed.estimate is not None:
            error[k] = np.hypot(*(np.array(followed.estimate.position_m[:2]) - p[k]))
    during = (t > 20.0) & (t < 34.0)
    return float(np.nanmax(error[during])), float(disturbed[during].mean()), float(disturbed[~during].mean())


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--walks", type=int, default=8)
    asked = parser.parse_args()
    grid, fits = hall_map(), tracking.is_disturbed
    print(f"{'size':>8} {'believed':>10} {'tested':>10} {'ratio':>7} {'disturbed during, else':>24}")
    good = True
    for size in SIZES_UT:
        tracking.is_disturbed = lambda *_: False
        believed = np.mean([walk(grid, size, seed)[0] for seed in range(asked.walks)])
        tracking.is_disturbed = fits
        tested, during, otherwise = np.mean([walk(grid, size, seed) for seed in range(asked.walks)], axis=0)
        print(
            f"{size:6g} uT {believed:8.2f} m {tested:8.2f} m {tested / believed:7.2f} {during:12.3f} {otherwise:11.4f}"
        )
        good &= tested < WITHIN * believed if size >= 10.0 else True
        good &= otherwise < 0.005 and (size > 0.0 or during == 0.0)
    print("PASS" if good else "FAIL")
    return 0 if good else 1


if __name__ == "__main__":
    with threadpool_limits(1):
        sys.exit(main())
