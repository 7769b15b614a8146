"""Disturbed stretches of a survey: what the walk shows by itself, and what the other surveys' map says of it.

A stretch that is excluded stays in the survey; maps are built without it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from app.attitude.departures import Expected
from app.attitude.stretches import DisturbedStretch, find_departures, find_disturbed_stretches
from app.errors import Fault, InvalidInput
from app.field.error_structure import ErrorStructure
from app.field.leave_one_out import HeldOut
from app.field.samples import Components, Samples
from app.geometry import Array

__all__ = ["MOST_JUDGED", "against_others", "by_itself", "checked_stretches", "union_s", "without_stretches"]

MOST_JUDGED = 8_000
"""Samples of a walk that are looked at one by one: of a longer one, means of neighbours."""
MOST_STRETCHES = 1000

Stretches = Sequence[Sequence[float]]
"""[[start, end], ...] in a survey's seconds."""


def by_itself(samples: Samples) -> list[dict[str, Any]]:
    """What the walk shows by itself, as JSON. A level walk, whose frame turns, is judged by its norm."""
    B_uT = samples.B_uT if samples.frame == "building" else np.linalg.norm(samples.B_uT, axis=1, keepdims=True)
    t, B, p = _thinned(samples.t_s, B_uT, samples.p_building_m)
    return _as_json(find_disturbed_stretches(t, B, p))


def against_others(
    samples: Samples, held_out: HeldOut, components: Components, structure: ErrorStructure
) -> list[dict[str, Any]]:
    """Where the walk departs from the map of the others, as JSON. A level map, which has no vector, says nothing."""
    if components == "level":
        return []
    B_uT = samples.features(components)
    mean = np.where(held_out.judged[:, None], B_uT - held_out.error_uT, np.nan)
    sd = np.where(held_out.judged[:, None], held_out.sd_uT, np.nan)
    t, B, p, mean, sd = _thinned(samples.t_s, B_uT, samples.p_building_m, mean, sd)
    return _as_json(find_departures(t, B, p, Expected(mean, sd, structure)))


def without_stretches(samples: Samples, excluded_s: Stretches) -> Samples:
    """The samples outside of these stretches."""
    kept = np.ones(len(samples), dtype=np.bool_)
    for start_s, end_s in excluded_s:
        kept &= (samples.t_s < start_s) | (samples.t_s > end_s)
    q = samples.q_body_to_building
    return replace(
        samples, t_s=samples.t_s[kept], p_building_m=samples.p_building_m[kept], B_uT=samples.B_uT[kept],
        q_body_to_building=None if q is None else q[kept],
    )  # fmt: skip


def checked_stretches(excluded_s: Stretches, location: str) -> list[list[float]]:
    """Stretches in order, those that touch made one. Raises InvalidInput for one that ends before it begins."""
    for index, (start_s, end_s) in enumerate(excluded_s):
        if not start_s <= end_s:
            reason = f"the stretch ends at {end_s:g} s, before it begins at {start_s:g} s"
            raise InvalidInput(reason, Fault(f"{location}/{index}", reason))
    return union_s(excluded_s)


def union_s(stretches: Stretches) -> list[list[float]]:
    """The same time as stretches that do not touch, in order."""
    out: list[list[float]] = []
    for start_s, end_s in sorted((float(a), float(b)) for a, b in stretches):
        if out and start_s <= out[-1][1]:
            out[-1][1] = max(out[-1][1], end_s)
        else:
            out.append([start_s, end_s])
    return out


def _thinned(t_s: Array, *columns: Array) -> tuple[Array, ...]:
    """Means of as many neighbours as leave at most MOST_JUDGED of them."""
    size = -(-len(t_s) // MOST_JUDGED)
    if size == 1:
        return (t_s, *columns)
    count = len(t_s) // size
    return tuple(
        np.asarray(each[: count * size].reshape(count, size, *each.shape[1:]).mean(axis=1)) for each in (t_s, *columns)
    )


def _as_json(stretches: Sequence[DisturbedStretch]) -> list[dict[str, Any]]:
    return [_told(each) for each in stretches[:MOST_STRETCHES]]


def _told(stretch: DisturbedStretch) -> dict[str, Any]:
    told: Mapping[str, Any] = asdict(stretch)
    return {name.replace("_uT", "_ut"): value for name, value in told.items()}
