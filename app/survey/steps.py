"""Steps from the accelerometer: peaks of the low-passed length of the specific force, length by Weinberg's rule."""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, find_peaks, sosfiltfilt

from app.geometry import Array

__all__ = ["STEP_LENGTH_FACTOR", "Steps", "detect_steps"]

STEP_LENGTH_FACTOR = 0.41
"""K of length = K amplitude^(1/4), amplitude in m/s^2: 0.40-0.415 over many walks of one surveyor (sd 12-14 %)."""
RATE_HZ = 50.0
CUTOFF_HZ = 3.0
SHORTEST_STEP_S = 0.3
LONGEST_STEP_S = 1.0
LONGEST_USUAL = 1.5
LEAST_PROMINENCE_M_PER_S2 = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Steps of a walk: when each began and ended (k,), and its modelled length (k,) in metres."""

    start_s: Array
    end_s: Array
    length_m: Array

    def __len__(self) -> int:
        return len(self.end_s)

    def distance_m(self, t_s: Array) -> Array:
        """(n,) distance walked by each time; even within a step, none between steps."""
        if not len(self):
            return np.zeros(len(t_s))
        walked = np.cumsum(self.length_m)
        times = np.stack([self.start_s, self.end_s], axis=1).ravel()
        done = np.stack([walked - self.length_m, walked], axis=1).ravel()
        return np.interp(t_s, times, done)


def detect_steps(t_s: Array, force_m_per_s2: Array) -> Steps:
    """Steps in accelerometer samples (n, 3) at times (n,).

    A step ends at a peak and begins at the peak before it; after standing still, and at the start, it is given about
    the usual time of a step, and may have begun before the recording did. A single peak is no walk.
    """
    grid_s = np.arange(t_s[0], t_s[-1], 1.0 / RATE_HZ)
    if len(grid_s) < RATE_HZ:
        return Steps(np.empty(0), np.empty(0), np.empty(0))
    length = np.interp(grid_s, t_s, np.linalg.norm(force_m_per_s2, axis=1))
    smooth = sosfiltfilt(butter(2, CUTOFF_HZ, fs=RATE_HZ, output="sos"), length - length.mean())
    distance = int(SHORTEST_STEP_S * RATE_HZ)
    peaks, _ = find_peaks(smooth, distance=distance, prominence=LEAST_PROMINENCE_M_PER_S2)
    if len(peaks) < 2:
        return Steps(np.empty(0), np.empty(0), np.empty(0))
    end_s = grid_s[peaks]
    usual_s = min(float(np.median(np.diff(end_s))), LONGEST_STEP_S)
    start_s = np.concatenate([[end_s[0] - usual_s], np.maximum(end_s[:-1], end_s[1:] - LONGEST_USUAL * usual_s)])
    starts = np.maximum(np.searchsorted(grid_s, start_s), 0)
    amplitude = np.array([smooth[p] - smooth[s : p + 1].min() for s, p in zip(starts, peaks, strict=True)])
    return Steps(start_s, end_s, STEP_LENGTH_FACTOR * amplitude**0.25)
