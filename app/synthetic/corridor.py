"""Storms' L-shaped corridor: a main and a side hallway, steel in their walls, and the map surveyed there (Storms 1.3).

x runs along the main hallway from its start, y to the left, z up; the source's Y, to the right with z down, is -y here
and its side hallway leads to the right. Sizes follow from the counts it gives: 108 and 51 survey steps of 0.381 m,
hallways six steps wide, so that its start, Y = 1.145 m, is the centre and all its test lines are columns of nodes.
Its survey has six columns of nodes, ours a seventh, on the wall, so that no walkable place is off the map.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline

from app.geometry import Array
from app.synthetic.steel import Dipoles
from app.tracking.kalman import constant_velocity
from app.tracking.map_cells import MapCells

__all__ = [
    "CORNER_M", "FINE_M", "NODE_M", "START_M", "WIDTH_M", "Corridor", "CorridorWalks", "inside", "make_corridor",
    "surveyed_cells", "walk_corridor",
]  # fmt: skip

NODE_M, FINE_M = 0.381, 0.0381
"""Spacing of the survey and of the map made of it (Storms, L476, L491)."""
WIDTH_M, LENGTH_M, DEPTH_M = 6 * NODE_M, 108 * NODE_M, 51 * NODE_M
"""Of both hallways; the main one's extent along x and the side one's along -y, the corner included in both."""
START_M = np.array([0.0, -1.145])
CORNER_M = np.array([LENGTH_M - WIDTH_M / 2.0, -WIDTH_M / 2.0])
"""Where vehicles start, and where the centre lines meet (Storms, L709, L817)."""

_EARTH_UT = np.array([18.0, 3.0, -48.0])
_HEIGHT_M, _CEILING_M = 0.9, 2.6
_GAP_M, _MARGIN_M = 0.4, 1.6
_DIPOLES_PER_M3 = 0.5
_TURN_BETWEEN_S = (65.0, 95.0)
_BATCH = 512


@dataclass(frozen=True, slots=True, eq=False)
class Corridor:
    """A uniform field (3,) and dipoles in walls, floor and ceiling; sensors move at one height."""

    earth_uT: Array
    steel: Dipoles

    def field_uT(self, points_m: Array) -> Array:
        """The field at points (n, 2) of the plan, at the sensors' height, uT (n, 3)."""
        at = np.column_stack([points_m, np.full(len(points_m), _HEIGHT_M)])
        return self.earth_uT + self.steel.field_uT(at)


class CorridorWalks(NamedTuple):
    """True states (k, n + 1, 4) `[x, y, vx, vy]` every `dt_s`, and the step (k,) before which each walk turned."""

    state: Array
    turn_step: NDArray[np.int64]
    dt_s: float


def make_corridor(rng: np.random.Generator, median_gradient_uT_per_m: float = 3.0) -> Corridor:
    """Draw a corridor whose field changes by so much per metre at the median, all components together."""
    low = np.array([-_MARGIN_M, -DEPTH_M - _MARGIN_M, -_MARGIN_M])
    high = np.array([LENGTH_M + _MARGIN_M, _MARGIN_M, _CEILING_M + _MARGIN_M])
    drawn = rng.uniform(low, high, (int(_DIPOLES_PER_M3 * np.prod(high - low)), 3))
    away = np.where((drawn[:, 2] > -_GAP_M) & (drawn[:, 2] < _CEILING_M + _GAP_M), ~inside(drawn[:, :2], _GAP_M), True)
    near = away & inside(drawn[:, :2], _MARGIN_M)
    steel = Dipoles(drawn[near], rng.normal(size=(int(near.sum()), 3)))
    place = _nodes_m().reshape(-1, 2)
    place = place[inside(place)]
    slopes = [(Corridor(_EARTH_UT, steel).field_uT(place + h) - Corridor(_EARTH_UT, steel).field_uT(place - h)) / 0.02
              for h in 0.01 * np.eye(2)]  # fmt: skip
    median = float(np.median(np.sqrt(np.sum(np.square(slopes), axis=(0, 2)))))
    return Corridor(_EARTH_UT, steel.scaled(median_gradient_uT_per_m / median))


def inside(points_m: Array, margin_m: float = 0.0) -> NDArray[np.bool_]:
    """Whether points (..., 2) are in the hallways, or no farther than a margin from them."""
    x, y = points_m[..., 0], points_m[..., 1]
    e = margin_m + 1e-9
    main = (x >= -e) & (x <= LENGTH_M + e) & (y >= -WIDTH_M - e) & (y <= e)
    side = (x >= LENGTH_M - WIDTH_M - e) & (x <= LENGTH_M + e) & (y >= -DEPTH_M - e) & (y <= e)
    return np.asarray(main | side)


def surveyed_cells(
    corridor: Corridor, rng: np.random.Generator, noise_uT: float = 0.0, drift_sd_uT: float = 0.0
) -> MapCells:
    """The map: nodes with white noise and a smooth drift since, bicubic in each hallway (Storms, L483-491).

    `drift_sd_uT` per component is of a map grown old: another corridor's steel, scaled. The stated variance is that of
    noise and drift; places outside the hallways are unknown.
    """
    nodes = _nodes_m()
    values = corridor.field_uT(nodes.reshape(-1, 2)) + noise_uT * rng.normal(size=(nodes.size // 2, 3))
    if drift_sd_uT:
        drift = make_corridor(rng).field_uT(nodes.reshape(-1, 2)) - _EARTH_UT
        values += drift * drift_sd_uT / drift[inside(nodes.reshape(-1, 2))].std(axis=0)
    values = values.reshape(*nodes.shape[:2], 3)
    x, y = np.asarray(np.arange(1081) * FINE_M), np.asarray(np.arange(511) * FINE_M - DEPTH_M)
    mean = np.zeros((len(y), len(x), 3))
    side, main = np.s_[:, 1020:], np.s_[450:, :]
    for c in range(3):
        mean[*side, c] = _bicubic(values[:, 102:, c], nodes[:, 0, 1], nodes[0, 102:, 0], y, x[1020:])
        mean[*main, c] = _bicubic(values[45:, :, c], nodes[45:, 0, 1], nodes[0, :, 0], y[450:], x)
    known = inside(np.stack(np.meshgrid(x, y), axis=-1))
    variance = np.full_like(mean, noise_uT**2 + drift_sd_uT**2)
    return MapCells((0.0, -DEPTH_M), FINE_M, mean, variance, known)


def walk_corridor(
    rng: np.random.Generator,
    count: int,
    sigma_a: float = 0.08,
    *,
    centring: float = 0.1,
    speed_m_s: float = 0.5,
    duration_s: float = 115.5,
    dt_s: float = 0.1,
) -> CorridorWalks:
    """True walks: white acceleration, a right turn at the corner, drawn to the centre line (Storms, L709-720).

    After each step `centring` times the distance from the centre line is taken back; the source does not say how much.
    Walks that leave the hallways or turn before 65 or after 95 s are drawn again. `sigma_a`^2 is a spectral density.
    """
    steps = round(duration_s / dt_s)
    states, turns = np.empty((0, steps + 1, 4)), np.empty(0, dtype=np.int64)
    while len(states) < count:
        state, turn = _batch(rng, sigma_a, centring, speed_m_s, steps, dt_s)
        turned_s = turn * dt_s
        kept = (turned_s >= _TURN_BETWEEN_S[0]) & (turned_s <= _TURN_BETWEEN_S[1])
        kept &= inside(state[..., :2], margin_m=1e-6).all(axis=1)
        states, turns = np.concatenate([states, state[kept]]), np.concatenate([turns, turn[kept]])
    return CorridorWalks(states[:count], turns[:count], dt_s)


def _batch(
    rng: np.random.Generator, sigma_a: float, centring: float, speed_m_s: float, steps: int, dt_s: float
) -> tuple[Array, NDArray[np.int64]]:
    model = constant_velocity(dt_s, sigma_a**2)
    root = np.linalg.cholesky(model.process_noise)
    out = np.empty((_BATCH, steps + 1, 4))
    state = np.tile([*START_M, speed_m_s, 0.0], (_BATCH, 1))
    turn = np.full(_BATCH, steps + 1)
    out[:, 0] = state
    for k in range(steps):
        now = (state[:, 0] >= CORNER_M[0]) & (turn > steps)
        turn[now] = k
        state[now, 2:] = np.column_stack([state[now, 3], -state[now, 2]])
        state = state @ model.transition.T + rng.normal(size=(_BATCH, 4)) @ root.T
        turned = turn <= k
        state[turned, 0] -= centring * (state[turned, 0] - CORNER_M[0])
        state[~turned, 1] -= centring * (state[~turned, 1] - CORNER_M[1])
        out[:, k + 1] = state
    return out, turn


def _nodes_m() -> Array:
    """(52, 109, 2) the survey's nodes in the rectangle around the L."""
    return np.stack(np.meshgrid(np.arange(109) * NODE_M, np.arange(52) * NODE_M - DEPTH_M), axis=-1)


def _bicubic(values: Array, y: Array, x: Array, y_fine: Array, x_fine: Array) -> Array:
    return np.asarray(RectBivariateSpline(y, x, values, s=0.0)(y_fine, x_fine))
