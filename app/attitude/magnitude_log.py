"""The magnitude's own filter over a log: the part of Brommer's filter that depends on no attitude (Brommer, L187)."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.attitude.disturbance import (
    MagnitudeEvent,
    MagnitudeState,
    OutlierRule,
    adapted_variance,
    check_log,
    event_row,
    gathered_events,
    watch,
)
from app.geometry import Array

__all__ = ["MagnitudeLog", "follow_magnitude"]


class MagnitudeLog(NamedTuple):
    """What the test said of a log: all (n,) but the events; `predicted_uT` before each reading, `sd_uT` its sd."""

    predicted_uT: Array
    sd_uT: Array
    innovation_uT: Array
    innovation_variance_uT2: Array
    outlier: NDArray[np.bool_]
    found: NDArray[np.bool_]
    disturbed: NDArray[np.bool_]
    events: tuple[MagnitudeEvent, ...]


def follow_magnitude(
    t_s: Array,
    magnitude_uT: Array,
    noise_variance_uT2: Array | float,
    *,
    rule: OutlierRule = OutlierRule(),  # noqa: B008  (a NamedTuple of numbers)
    walk_psd_uT2_per_s: float = 0.0,
    start: tuple[float, float] | None = None,
    reject: bool = True,
    adapt: bool = True,
    drift_uT_per_s: Array | float = 0.0,
) -> MagnitudeLog:
    """The magnitude's own Kalman filter over a log (n,), with test, rejection of outliers, and adaptation.

    walk_psd_uT2_per_s   random walk of the field: 0 as the source, which freezes the belief after some minutes
    start                believed magnitude and its variance; by default the first reading, four times as unsure
    drift_uT_per_s       (n,) or one: how fast the magnitude may change with movement, gradient times speed. Its
                         square times a second joins the random walk

    Raises InvalidInput for fewer than two readings, times that decrease, or readings that are not finite.
    """
    t, z = np.ascontiguousarray(t_s, np.float64), np.ascontiguousarray(magnitude_uT, np.float64)
    R = np.ascontiguousarray(np.broadcast_to(np.asarray(noise_variance_uT2, np.float64), z.shape))
    psd = walk_psd_uT2_per_s + np.square(np.broadcast_to(np.asarray(drift_uT_per_s, np.float64), z.shape))
    check_log(t, z)
    first, variance = (float(z[0]), 4.0 * float(R[0])) if start is None else start
    rule = rule.check()._replace(adapting=adapt)
    columns, flags, states = _follow(t, z, R, np.ascontiguousarray(psd), rule, first, variance, reject, adapt)
    return MagnitudeLog(
        columns[:, 0], np.sqrt(columns[:, 1]), columns[:, 2], columns[:, 3], flags[:, 0] == 1, flags[:, 1] == 1,
        flags[:, 2] == 1, gathered_events(states),
    )  # fmt: skip


@njit(cache=True)
def _follow(t, z, R, psd, rule, first, variance, reject, adapt):  # type: ignore[no-untyped-def]
    columns, flags = np.empty((len(t), 4)), np.zeros((len(t), 3), np.int8)
    events = []
    state = MagnitudeState(0, 0, 0.0, 0.0, 0.0, -1e300, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0)
    r, P, last = first, variance, t[0]
    for k in range(len(t)):
        P += psd[k] * (t[k] - last)
        last = t[k]
        seen = watch(state, rule, t[k], z[k], R[k], r, P)
        columns[k, 0], columns[k, 1], columns[k, 2], columns[k, 3] = r, P, seen.innovation_uT, P + R[k]
        if seen.ended == 1:
            events.append(event_row(state, seen.ended_s, seen.returned))
        state = seen.state
        flags[k, 0], flags[k, 1], flags[k, 2] = seen.outlier, seen.found, state.in_event
        if seen.found == 1 and adapt:
            P = adapted_variance(P, seen.innovation_uT, R[k])
        elif seen.outlier == 1 and reject:
            continue
        gain = P / (P + R[k])
        r += gain * seen.innovation_uT
        P = (1.0 - gain) ** 2 * P + gain * gain * R[k]
    if state.in_event == 1:
        events.append(event_row(state, np.nan, 0))
    rows = np.empty((len(events), 6))
    for k in range(len(events)):
        rows[k] = events[k]
    return columns, flags, rows
