"""Fixed-lag smoothing: where the particles that live now were some metres ago.

Resampling keeps those whose whole way fits, so that the mean of their places of then, with their weights of now, is the
place in the light of all that was measured since (the storage smoother of Kitagawa, with a lag short enough that many
ancestors are left).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.tracking.particles import Particles

__all__ = ["Lag", "Node", "Smoothed", "along", "empty_lag", "inherit", "remember", "settle"]

NODE_M = 0.5  # walked between places that are remembered


@dataclass(frozen=True, slots=True)
class Node:
    """A step whose place is remembered."""

    number: int
    t_s: float
    path_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Lag:
    """Nodes not yet settled; position_m (nodes, n, 3) and floor (nodes, n) of what became each particle."""

    nodes: tuple[Node, ...]
    position_m: NDArray[np.float32]
    floor: NDArray[np.int8]


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """A place in the light of what came after it."""

    node: Node
    floor: int
    position_m: tuple[float, float, float]
    covariance_m2: Array


def empty_lag(particles: int) -> Lag:
    return Lag((), np.zeros((0, particles, 3), dtype=np.float32), np.zeros((0, particles), dtype=np.int8))


def along(nodes: tuple[Node, ...], position_m: Array, particles: Particles) -> Lag:
    """Of particles that came along known ways (nodes, n, 2)."""
    height = np.broadcast_to(particles.rows[:, 2], (len(nodes), len(particles)))
    place = np.concatenate([position_m, height[..., None]], axis=2).astype(np.float32)
    floor = np.broadcast_to(particles.floor.astype(np.int8), (len(nodes), len(particles)))
    return Lag(nodes, place, floor.copy())


def remember(lag: Lag, node: Node, particles: Particles) -> Lag:
    """The particles' places as those of a node, if it is far enough from the one before."""
    if lag.nodes and node.path_m - lag.nodes[-1].path_m < NODE_M:
        return lag
    place = particles.rows[None, :, :3].astype(np.float32)
    floor = particles.floor[None].astype(np.int8)
    return Lag((*lag.nodes, node), np.concatenate([lag.position_m, place]), np.concatenate([lag.floor, floor]))


def inherit(lag: Lag, chosen: NDArray[np.int64]) -> Lag:
    """After resampling."""
    return replace(lag, position_m=lag.position_m[:, chosen], floor=lag.floor[:, chosen])


def settle(lag: Lag, weight: Array, before_m: float) -> tuple[Lag, tuple[Smoothed, ...]]:
    """The nodes at most `before_m` along the path, settled, and the others."""
    settled = sum(node.path_m <= before_m for node in lag.nodes)
    places = tuple(_smoothed(lag, k, weight) for k in range(settled))
    if not settled:
        return lag, ()
    return Lag(lag.nodes[settled:], lag.position_m[settled:], lag.floor[settled:]), places


def _smoothed(lag: Lag, k: int, weight: Array) -> Smoothed:
    floor = int(np.argmax(np.bincount(lag.floor[k], weights=weight)))
    here = lag.floor[k] == floor
    w = weight[here] / weight[here].sum()
    place = lag.position_m[k, here].astype(np.float64)
    mean = w @ place
    off = place[:, :2] - mean[:2]
    return Smoothed(lag.nodes[k], floor, (float(mean[0]), float(mean[1]), float(mean[2])), (w[:, None] * off).T @ off)
