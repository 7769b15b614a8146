"""What is found in any walk: counts, lengths, rates, gaps, as plain JSON."""

import numpy as np

from app.field.samples import Samples

__all__ = ["describe_samples", "sample_warnings"]

GAP_FACTOR, GAP_MIN_S = 5.0, 0.5
STATIONARY_M_PER_S = 0.1
_SPEED_WINDOW_S = 1.0


def describe_samples(samples: Samples) -> dict[str, object]:
    """Sample count, duration, path length, rate, percentiles of |B|, gaps and the share of time standing still."""
    t_s = samples.t_s
    interval_s = np.diff(t_s)
    norm_uT = np.linalg.norm(samples.B_uT, axis=1)
    gaps = interval_s[interval_s > max(GAP_MIN_S, GAP_FACTOR * float(np.median(interval_s)))]
    low, high = samples.p_building_m.min(axis=0), samples.p_building_m.max(axis=0)
    return {
        "frame": samples.frame,
        "samples": len(samples),
        "duration_s": _round(t_s[-1] - t_s[0]),
        "path_length_m": _round(samples.path_length_m()[-1]),
        "rate_hz": _round(1.0 / float(np.median(interval_s))),
        "b_norm_ut": {f"p{q}": _round(np.percentile(norm_uT, q)) for q in (0, 5, 50, 95, 100)},
        "bounds_m": [_round(x) for x in (*low, *high)],
        "gaps": {"count": len(gaps), "longest_s": _round(gaps.max()) if len(gaps) else 0.0},
        "stationary_share": _round(_stationary_share(samples)),
    }


def sample_warnings(samples: Samples) -> list[str]:
    """What a surveyor should look at, though it does not forbid using the walk."""
    described = describe_samples(samples)
    found: list[str] = []
    gaps = described["gaps"]
    assert isinstance(gaps, dict)
    if gaps["count"]:
        found.append(f"{gaps['count']} gaps in time, the longest {gaps['longest_s']:g} s: the field between is unknown")
    if float(samples.path_length_m()[-1]) < 1.0:
        found.append("the walk covers less than a metre: it tells the map about one place only")
    norm_uT = np.linalg.norm(samples.B_uT, axis=1)
    if len(samples) > 10 and float(np.ptp(norm_uT)) == 0.0:
        found.append("|B| never changes: the magnetometer was stuck")
    return found


def _stationary_share(samples: Samples) -> float:
    """Share of the time during which less than 0.1 m/s was walked, over windows of about a second."""
    path_m, t_s = samples.path_length_m(), samples.t_s
    ahead = np.minimum(np.searchsorted(t_s, t_s + _SPEED_WINDOW_S), len(t_s) - 1)
    elapsed_s = t_s[ahead] - t_s
    moving = elapsed_s > 0
    slow = (path_m[ahead] - path_m)[moving] < STATIONARY_M_PER_S * elapsed_s[moving]
    weight = np.append(np.diff(t_s), 0.0)[moving]
    return float(np.sum(weight * slow) / np.sum(weight))


def _round(x: float) -> float:
    return round(float(x), 4)
