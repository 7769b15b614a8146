"""Which stretches of a walk were disturbed: by a passing trolley, a motor, a lift, a phone call.

Indoors the field changes along a walk anyway, so a disturbance is a change in time that movement does not explain:
a step or hum too sudden for walking, a change while standing still, a place that reads otherwise when it is visited
again, and, where a map from other surveys is at hand, a departure from it beyond its errors. What passes as smoothly
as steel on the way does, on a walk that neither stops nor returns and has no map, cannot be told from the building.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.attitude.departures import Departure, Expected, departures, expected_from_other_visits
from app.attitude.disturbance import check_log
from app.attitude.standstill import find_changes_at_rest, typical_gradient_uT_per_m
from app.attitude.sudden_changes import ORDER, Step, find_hum, find_steps, find_stuck, white_noise_sd_uT
from app.errors import Fault, InvalidInput
from app.geometry import Array, path_length_m

__all__ = ["DisturbedStretch", "StretchKind", "disturbed_samples", "find_departures", "find_disturbed_stretches"]

StretchKind = Literal["step and back", "step that stays", "step", "hum", "stuck", "standstill", "revisit", "map"]

ATTITUDE_SD_RAD = 0.03
"""By which up and heading wander along a walk, seconds apart."""
STAYS_UT, STAYS_CHANCE, STAYS_OUT = 6.0, 1e-6, 3.0
"""A step this large, clear and sudden that nothing takes back is an object attached, or a sensor calibrated anew."""
BACK_SHARE = 0.5
LONGEST_BACK_S = 120.0
AROUND_S = 0.5
AROUND_STUCK_S = 0.7
STUCK_CHANCE = 1e-6
FEWEST = 20


@dataclass(frozen=True, slots=True)
class DisturbedStretch:
    """A stretch of a walk, in its seconds: what was seen (`reason`, for people), how large, and how likely by chance.

    `p_value` is of the whole walk: the probability of anything as clear in an undisturbed one of its length.
    """

    start_s: float
    end_s: float
    kind: StretchKind
    reason: str
    size_uT: float
    p_value: float


def find_disturbed_stretches(
    t_s: Array,
    B_uT: Array,
    p_building_m: Array,
    *,
    expected: Expected | None = None,
    attitude_sd_rad: float = ATTITUDE_SD_RAD,
) -> tuple[DisturbedStretch, ...]:
    """Disturbed stretches of a walk in order of time; what overlaps is one, named by the clearest of it.

    t_s             (n,) seconds, strictly increasing
    B_uT            (n, 3) in the building's or the walk's level frame turned by one heading, or (n,) or (n, 1): norms
    p_building_m    (n, 3) or (n, 2)
    expected        what other surveys lead one to expect at those places
    attitude_sd_rad by which the frame of the readings wanders; norms do not care

    A walk of fewer than twenty samples is not judged: (). Raises InvalidInput for arrays of unequal length, times
    that do not increase, or readings that are not numbers.
    """
    t, B, p = (np.asarray(x, np.float64) for x in (t_s, B_uT, p_building_m))
    B = B[:, None] if B.ndim == 1 else B
    check_log(t, B)
    if len(p) != len(t) or not np.isfinite(p).all():
        raise InvalidInput(
            f"{len(p)} positions for {len(t)} readings; give a finite one for each",
            Fault("p_building_m", "not one per reading, or not finite"),
        )
    if not np.all(np.diff(t) > 0.0):
        raise InvalidInput("two readings have one time; average them", Fault("t_s", "times do not increase"))
    if len(t) < max(FEWEST, 3 * ORDER):
        return ()
    found = [*_sudden(t, B), *_slow(t, B, p, attitude_sd_rad if B.shape[1] == 3 else 0.0)]
    if expected is not None:
        found += find_departures(t, B, p, expected)
    return _merged(found)


def find_departures(t_s: Array, B_uT: Array, p_building_m: Array, expected: Expected) -> list[DisturbedStretch]:
    """The stretches of kind "map" alone: where readings (n, c) depart from what other surveys lead one to expect."""
    return [_departed(t_s, each, "map") for each in departures(t_s, path_length_m(p_building_m), B_uT, expected)]


def disturbed_samples(t_s: Array, stretches: tuple[DisturbedStretch, ...]) -> NDArray[np.bool_]:
    """(n,) whether each time lies in one of the stretches."""
    out = np.zeros(len(t_s), dtype=bool)
    for each in stretches:
        out |= (t_s >= each.start_s) & (t_s <= each.end_s)
    return out


def _sudden(t: Array, B: Array) -> list[DisturbedStretch]:
    noise = white_noise_sd_uT(B)
    if noise <= 0.0:
        noise = 1e-3  # a sensor that repeats itself
    stuck = find_stuck(B, noise)
    at_rest = [(t[a] - AROUND_STUCK_S, t[b - 1] + AROUND_STUCK_S) for a, b in stuck]
    all_steps = find_steps(t, B, noise)
    steps = [
        step
        for step in all_steps
        if not any(t[step.after] >= from_s and t[step.before] <= to_s for from_s, to_s in at_rest)
    ]
    repeats = [
        _stretch(t, a, b - 1, "stuck", "the sensor repeats one reading while it is carried on", 0.0, STUCK_CHANCE)
        for a, b in stuck
    ]
    known = [(step.before, step.after) for step in all_steps] + [(a - 1, min(b, len(t) - 1)) for a, b in stuck]
    hum = [
        DisturbedStretch(
            float(t[each.start]), float(t[min(each.stop, len(t)) - 1]), "hum",
            f"readings rattle by {each.sd_uT:.1f} uT, the rest of the walk by {noise:.1f}", each.sd_uT, each.p_value,
        )
        for each in find_hum(t, B, noise, known)
    ]  # fmt: skip
    return [*_paired(t, steps), *hum, *repeats]


def _paired(t: Array, steps: list[Step]) -> list[DisturbedStretch]:
    """Steps with the one that takes them back, steps that stay, and lesser ones, which tell only of their moment."""
    out, used = [], set()
    for k, step in enumerate(steps):
        if k in used:
            continue
        for j in range(k + 1, len(steps)):
            later = steps[j]
            remains = float(np.linalg.norm(step.change_uT + later.change_uT))
            if t[later.after] - t[step.before] <= LONGEST_BACK_S and remains <= BACK_SHARE * step.size_uT:
                used |= set(range(k, j + 1))
                reason = f"the field steps by {step.size_uT:.1f} uT and back"
                p_value = max(step.p_value, later.p_value)
                out.append(_stretch(t, step.before, later.after, "step and back", reason, step.size_uT, p_value))
                break
        else:
            clear = step.p_value <= STAYS_CHANCE and step.stands_out >= STAYS_OUT
            if step.size_uT >= STAYS_UT and clear:
                reason = f"the field steps by {step.size_uT:.1f} uT and stays: something attached, or a recalibration"
                last = len(t) - 1
                out.append(_stretch(t, step.before, last, "step that stays", reason, step.size_uT, step.p_value))
            else:
                reason = f"the field steps by {step.size_uT:.1f} uT, faster than walking explains"
                out.append(_stretch(t, step.before, step.after, "step", reason, step.size_uT, step.p_value, AROUND_S))
    return out


def _slow(t: Array, B: Array, p: Array, attitude_sd_rad: float) -> list[DisturbedStretch]:
    noise, path_m = white_noise_sd_uT(B), path_length_m(p)
    gradient = typical_gradient_uT_per_m(path_m, B)
    still = [
        _stretch(
            t, each.start, each.stop - 1, "standstill",
            f"the field changes by {each.size_uT:.1f} uT while the device stands still", each.size_uT, each.p_value,
        )
        for each in find_changes_at_rest(t, p, B, noise, gradient, attitude_sd_rad)
    ]  # fmt: skip
    visits = expected_from_other_visits(t, p, B, noise, gradient, attitude_sd_rad)
    return [*still, *(_departed(t, each, "revisit") for each in departures(t, path_m, B, visits))]


def _departed(t: Array, each: Departure, kind: Literal["revisit", "map"]) -> DisturbedStretch:
    against = "another visit of the same places" if kind == "revisit" else "the map of the other surveys"
    reason = f"the field is {each.size_uT:.1f} uT off {against}"
    return _stretch(t, each.start, each.stop - 1, kind, reason, each.size_uT, each.p_value)


def _stretch(
    t: Array,
    first: int,
    last: int,
    kind: StretchKind,
    reason: str,
    size_uT: float,
    p_value: float,
    around_s: float = 0.0,
) -> DisturbedStretch:
    start_s, end_s = max(float(t[first]) - around_s, float(t[0])), min(float(t[last]) + around_s, float(t[-1]))
    return DisturbedStretch(start_s, end_s, kind, reason, size_uT, min(p_value, 1.0))


def _merged(found: list[DisturbedStretch]) -> tuple[DisturbedStretch, ...]:
    """Stretches that overlap made one: from the first start to the last end, the rest from the smallest p-value."""
    out: list[DisturbedStretch] = []
    for each in sorted(found, key=lambda stretch: stretch.start_s):
        if not out or each.start_s > out[-1].end_s:
            out.append(each)
            continue
        clearest = min(out[-1], each, key=lambda stretch: stretch.p_value)
        out[-1] = DisturbedStretch(
            out[-1].start_s, max(out[-1].end_s, each.end_s), clearest.kind, clearest.reason, clearest.size_uT,
            clearest.p_value,
        )  # fmt: skip
    return tuple(out)
