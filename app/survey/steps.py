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

    A step ends at a peak and begins at the peak before it, or `LONGEST_STEP_S` earlier after standing still.
    """
    grid_s = np.arange(t_s[0], t_s[-1], 1.0 / RATE_HZ)
    if len(grid_s) < RATE_HZ:
        return Steps(np.empty(0), np.empty(0), np.empty(0))
    length = np.interp(grid_s, t_s, np.linalg.norm(force_m_per_s2, axis=1))
    smooth = sosfiltfilt(butter(2, CUTOFF_HZ, fs=RATE_HZ, output="sos"), length - length.mean())
    distance = int(SHORTEST_STEP_S * RATE_HZ)
    peaks, _ = find_peaks(smooth, distance=distance, prominence=LEAST_PROMINENCE_M_PER_S2)
    longest = int(LONGEST_STEP_S * RATE_HZ)
    starts = np.maximum(np.concatenate([[0], peaks[:-1]]), peaks - longest) if len(peaks) else peaks
    amplitude = np.array([smooth[p] - smooth[s : p + 1].min() for s, p in zip(starts, peaks, strict=True)])
    return Steps(grid_s[starts], grid_s[peaks], STEP_LENGTH_FACTOR * amplitude**0.25)
