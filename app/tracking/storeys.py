"""From floor to floor: by the height a device reckons, or, of one that does not, where floors are joined."""

from dataclasses import replace

import numpy as np

from app.geometry import Array
from app.tracking.ground import Connector
from app.tracking.particles import BETWEEN_FLOORS_M, Particles, Z
from app.tracking.places import Places

__all__ = ["settle_heights", "share_between_floors", "through_connectors"]

LEVELS_OUT_M = 10.0  # walked along a floor, until a reckoned height is forgotten for the floor's own
STAIRS_M = 4.0  # walked on stairs, until one is likely on another floor
LIFT_S = 5.0  # spent in a lift, likewise
BETWEEN_M = 1.5  # above a floor: on the way to another, where the floor's map holds no longer


def settle_heights(particles: Particles, places: Places, distance_m: float, risen_m: float) -> Particles:
    """Each particle on the floor nearest to its height, which drifts towards that floor's where the ground is level."""
    rows = particles.rows.copy()
    floor = particles.floor
    if risen_m != 0.0 and places.count > 1:
        floor = np.argmin(np.abs(rows[:, Z, None] - places.heights_m), axis=1)
    level = np.exp(-max(distance_m - 2.0 * abs(risen_m), 0.0) / LEVELS_OUT_M)
    height = places.heights_m[floor]
    low, high = places.lowest_m[floor], places.highest_m[floor]
    at = np.where(high > low, np.clip(rows[:, Z], low, high), height)  # a map of several heights holds between them
    rows[:, Z] = at + level * (rows[:, Z] - at)
    return replace(particles, rows=rows, floor=floor)


def share_between_floors(particles: Particles, weight: Array, places: Places) -> float:
    """Of the belief, that is on the way from floor to floor, where no map tells anything."""
    z, floor = particles.rows[:, Z], particles.floor
    beyond = np.maximum(places.lowest_m[floor] - z, z - places.highest_m[floor])
    return float(weight @ (beyond > BETWEEN_FLOORS_M))


def through_connectors(
    particles: Particles, places: Places, floor_ids: tuple[str, ...], connectors: tuple[Connector, ...],
    distance_m: float, elapsed_s: float, rng: np.random.Generator,
) -> Particles:  # fmt: skip
    """Particles in stairs or a lift, some of them on another floor of it: the device does not tell its height."""
    floor, rows = particles.floor.copy(), particles.rows.copy()
    height = places.heights_m[floor]
    for connector in connectors:
        joined = np.array([floor_ids.index(each) for each in connector.floor_ids if each in floor_ids], dtype=np.int64)
        inside = connector.inside(rows[:, :2]) & np.isin(floor, joined)
        rate = distance_m / STAIRS_M if connector.kind == "stairs" else elapsed_s / LIFT_S
        changing = np.flatnonzero(inside & (rng.uniform(size=len(rows)) < 1.0 - np.exp(-rate)))
        if len(joined) > 1 and len(changing):
            floor[changing] = joined[rng.integers(len(joined), size=len(changing))]
        height[inside] = places.highest_m[floor[inside]] + BETWEEN_M
    rows[:, Z] = height
    return replace(particles, rows=rows, floor=floor)
