"""Is the magnetic field disturbed? A chi-square test of the magnitude, a rule for runs of outliers, and events.

A reading is an outlier if its magnitude misses the predicted one by more than three sds (Brommer, L175, L191, Eq. 16).
Enough outliers at a stretch are a disturbance (Brommer, L179). The prediction may be a filter's belief, which is then
made unsure enough to take the new field in (Brommer, L189-197, Eqs. 17-18), or a map's at the place, which stays.

`watch` is one step, for filters that hold a `MagnitudeState` of plain numbers. `app.attitude.magnitude_log` runs a log.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from scipy.special import ndtr
from scipy.stats import chi2

from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = [
    "CHANCE", "MagnitudeEvent", "MagnitudeState", "OutlierRule", "Watched", "adapted_variance", "check_log",
    "critical_value", "detection_power", "event_row", "gathered_events", "innovation_statistic", "watch",
    "watch_outlier",
]  # fmt: skip

CHANCE = 0.0026997960632601866
"""Of a Gaussian beyond three sds: the nominal rate of outliers (Brommer, L175)."""

FEWEST_LASTING = 3
"""A run counted by its duration has at least as many outliers, however slow the sensor."""


def critical_value(degrees_of_freedom: int = 1, chance: float = CHANCE) -> float:
    """What chi-square exceeds with that probability: 9 for a scalar, 14.156 for a vector (Brommer, L175)."""
    return float(chi2.isf(chance, degrees_of_freedom))


def innovation_statistic(innovation: Array, covariance: Array) -> Array:
    """y^T S^-1 y of innovations (..., k) and covariances (..., k, k): chi-square with k degrees of freedom."""
    solved = np.linalg.solve(covariance, innovation[..., None])[..., 0]
    return np.asarray(np.sum(innovation * solved, axis=-1))


class OutlierRule(NamedTuple):
    """When outliers are a disturbance: `needed` of the `window` latest readings, 11 of 11 by default.

    The source has "more than 10" at 50 Hz (Brommer, L179), 11 of 11; and "after 10" (L197), 10 of 10. For other rates:
    `lasting_s` above 0 asks instead for an unbroken run, three at least, from the first to the last of which that much
    time has passed. 0.2 s is the 11th at 50 Hz, the 13th at 60 Hz. A gap longer than `longest_gap_s` ends a run.

    threshold       of the squared innovation over its variance
    settles_after_s a disturbance that lasts longer is the new field, and its event is closed as not returned
    adapting        the prediction follows the readings (a filter's belief): an event ends when the magnitude is back
                    where it was before. Otherwise (a map) when as many readings as found it agree with the prediction
    """

    needed: int = 11
    window: int = 11
    lasting_s: float = 0.0
    threshold: float = 9.0
    longest_gap_s: float = 1.0
    settles_after_s: float = 120.0
    adapting: bool = True

    def check(self) -> "OutlierRule":
        """Itself. Raises InvalidInput if no readings could satisfy it, or the window exceeds 62."""
        if not 1 <= self.needed <= self.window <= 62:
            raise InvalidInput(
                f"{self.needed} of {self.window} outliers cannot be asked for; give 1 <= needed <= window <= 62",
                Fault("rule.needed", "not between 1 and the window"),
            )
        for name in ("threshold", "longest_gap_s", "settles_after_s"):
            if not getattr(self, name) > 0.0:
                raise InvalidInput(f"{name} must be above 0", Fault(f"rule.{name}", f"is {getattr(self, name)}"))
        return self


class MagnitudeState(NamedTuple):
    """What is remembered between readings: plain numbers, to be held by a filter and stored with it.

    recent              outcomes of the latest readings, the last in the lowest bit: 1 is an outlier
    run, run_start_s    outliers without a break, and when the present cluster of them began
    run_predicted_uT, run_variance_uT2   the prediction and its variance when that cluster began
    last_s              time of the last reading
    in_event            1 while the field is disturbed
    event_start_s, event_found_s         first outlier of the event, and when the rule was satisfied
    before_uT, before_variance_uT2       magnitude believed before the event
    shift_uT            largest departure from it when the rule was satisfied, with its sign
    agreeing, agreeing_since_s           readings without a break that agree again, and since when
    """

    recent: int = 0
    run: int = 0
    run_start_s: float = 0.0
    run_predicted_uT: float = 0.0
    run_variance_uT2: float = 0.0
    last_s: float = -1e300
    in_event: int = 0
    event_start_s: float = 0.0
    event_found_s: float = 0.0
    before_uT: float = 0.0
    before_variance_uT2: float = 0.0
    shift_uT: float = 0.0
    agreeing: int = 0
    agreeing_since_s: float = 0.0


class Watched(NamedTuple):
    """What one reading said.

    state                the state to remember
    innovation_uT, innovation_variance_uT2   measured less predicted magnitude, and S
    outlier              1 if beyond the threshold
    found                1 if the rule is satisfied by this reading: a belief should be adapted now
    ended                1 if an event ended; its numbers are in the state given before, its end in `ended_s`
    returned             1 if it ended because the magnitude came back
    """

    state: MagnitudeState
    innovation_uT: float
    innovation_variance_uT2: float
    outlier: int
    found: int
    ended: int
    ended_s: float
    returned: int


@njit(cache=True)
def watch(
    state: MagnitudeState,
    rule: OutlierRule,
    t_s: float,
    measured_uT: float,
    noise_variance_uT2: float,
    predicted_uT: float,
    predicted_variance_uT2: float,
) -> Watched:
    """Judge one reading of the magnitude against its prediction (Brommer, L175-197). Times must not decrease.

    noise_variance_uT2      of the magnitude: u^T R u for a reading along the unit vector u
    predicted_variance_uT2  of the prediction alone: a filter's P_rr, a map's variance at the place with all its errors
    """
    y = measured_uT - predicted_uT
    outlier = y * y > rule.threshold * (predicted_variance_uT2 + noise_variance_uT2)
    return watch_outlier(
        state, rule, t_s, outlier, measured_uT, noise_variance_uT2, predicted_uT, predicted_variance_uT2
    )


@njit(cache=True)
def watch_outlier(
    state: MagnitudeState,
    rule: OutlierRule,
    t_s: float,
    failed: bool,
    measured_uT: float,
    noise_variance_uT2: float,
    predicted_uT: float,
    predicted_variance_uT2: float,
) -> Watched:
    """`watch` for a reading that another test has judged, of three components say."""
    y, S = measured_uT - predicted_uT, predicted_variance_uT2 + noise_variance_uT2
    outlier = 1 if failed else 0
    recent, run, run_start_s = state.recent, state.run, state.run_start_s
    run_predicted, run_variance = state.run_predicted_uT, state.run_variance_uT2
    agreeing = state.agreeing
    if t_s - state.last_s > rule.longest_gap_s:
        recent, run, agreeing = 0, 0, 0
    mask = (1 << rule.window) - 1
    scattered = rule.lasting_s <= 0.0 and rule.needed < rule.window
    if outlier == 1 and (run == 0 if not scattered else (recent << 1) & mask == 0):
        run_start_s, run_predicted, run_variance = t_s, predicted_uT, predicted_variance_uT2
    recent = ((recent << 1) | outlier) & mask
    run = run + 1 if outlier == 1 else 0
    if rule.lasting_s > 0.0:
        found = 1 if run >= FEWEST_LASTING and t_s - run_start_s >= rule.lasting_s - 1e-9 else 0
    else:
        count, bits = 0, recent
        while bits:
            bits &= bits - 1
            count += 1
        found = 1 if outlier == 1 and count >= rule.needed else 0

    in_event, start_s, found_s = state.in_event, state.event_start_s, state.event_found_s
    before, before_variance, shift = state.before_uT, state.before_variance_uT2, state.shift_uT
    agreeing_since_s = state.agreeing_since_s
    ended, ended_s, returned = 0, 0.0, 0
    if in_event == 1:
        reference = before if rule.adapting else predicted_uT
        variance = before_variance if rule.adapting else predicted_variance_uT2
        off = measured_uT - reference
        if off * off > rule.threshold * (variance + noise_variance_uT2):
            agreeing = 0
        else:
            if agreeing == 0:
                agreeing_since_s = t_s
            agreeing += 1
        enough = agreeing >= rule.needed
        if rule.lasting_s > 0.0:
            enough = agreeing >= FEWEST_LASTING and t_s - agreeing_since_s >= rule.lasting_s - 1e-9
        if enough:
            in_event, ended, ended_s, returned = 0, 1, agreeing_since_s, 1
        elif t_s - start_s > rule.settles_after_s:
            in_event, ended, ended_s = 0, 1, t_s
    if found == 1:
        if in_event == 0 and not (ended == 1 and returned == 1):
            in_event, start_s, found_s, agreeing = 1, run_start_s, t_s, 0
            before, before_variance = run_predicted, run_variance
            shift = measured_uT - before
        if in_event == 1 and abs(measured_uT - before) > abs(shift):
            shift = measured_uT - before
        if rule.adapting:
            recent, run = 0, 0
    new = MagnitudeState(
        recent, run, run_start_s, run_predicted, run_variance, t_s, in_event, start_s, found_s, before,
        before_variance, shift, agreeing, agreeing_since_s,
    )  # fmt: skip
    return Watched(new, y, S, outlier, found, ended, ended_s, returned)


@njit(cache=True)
def adapted_variance(variance: float, innovation: float, noise_variance: float) -> float:
    """P <- y^2 - R, never smaller than it was: the innovation becomes one of one sd (Brommer, L189-195, Eqs. 17-18)."""
    return max(variance, innovation * innovation - noise_variance)


@dataclass(frozen=True, slots=True)
class MagnitudeEvent:
    """A disturbance, in the log's seconds: first outlier, when it was known, and when it ended (None: it had not).

    `shift_uT` is the largest departure from the magnitude before, with its sign; `returned` tells whether the
    magnitude came back, rather than being taken for the new field or the log ending.
    """

    start_s: float
    found_s: float
    end_s: float | None
    shift_uT: float
    before_uT: float
    returned: bool


def check_log(t_s: Array, values: Array) -> None:
    """Raises InvalidInput unless times (n,) and values (n, ...) make a log."""
    if len(t_s) < 2 or len(t_s) != len(values):
        raise InvalidInput(
            f"{len(t_s)} times and {len(values)} readings make no log; give two or more of each",
            Fault("t_s", "fewer than two, or not one per reading"),
        )
    if not np.all(np.diff(t_s) >= 0.0):
        at = int(np.argmin(np.diff(t_s) >= 0.0)) + 1
        raise InvalidInput(
            f"time {at} is before the one it follows; sort the log", Fault(f"t_s[{at}]", "times decrease")
        )
    finite = np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if not finite.all():
        at = int(np.argmin(finite))
        raise InvalidInput(f"reading {at} is not a number; leave it out", Fault(f"readings[{at}]", "not finite"))


@njit(cache=True)
def event_row(state: MagnitudeState, ended_s: float, returned: int) -> Array:
    """(6,) an event's numbers, as `gathered_events` reads them."""
    return np.array(
        [state.event_start_s, state.event_found_s, ended_s, state.shift_uT, state.before_uT, float(returned)]
    )


def gathered_events(rows: Array) -> tuple[MagnitudeEvent, ...]:
    """Events of rows (k, 6) of `event_row`; an end that is no number is none."""
    return tuple(
        MagnitudeEvent(a, b, None if np.isnan(c) else c, shift, before, returned == 1.0)
        for a, b, c, shift, before, returned in rows.tolist()
    )


def detection_power(step_sds: Array | float, rule: OutlierRule | None = None) -> Array:
    """Probability that the first `needed` readings after a step of so many sds all fail, the state held frozen.

    Phi(k - 3)^11 with the default rule: 0.15 at 4 sds, 0.78 at 5 (Brommer, by L175-197). Other tails count too.
    """
    rule = OutlierRule() if rule is None else rule
    k, bound = np.asarray(step_sds, np.float64), np.sqrt(rule.threshold)
    return np.asarray((ndtr(k - bound) + ndtr(-k - bound)) ** rule.needed)
