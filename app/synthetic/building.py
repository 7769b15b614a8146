"""A synthetic building: steel in its slabs, walls and ceilings, and the Earth's field through it all.

No pole, dipole or surface lies within a metre of the device of somebody who walks, so the field is smooth there. The
strength of the steel is set so that the field at device height varies as in real buildings: a standard deviation of
about 5 uT per component, a correlation length of 2-6 m, |B| within 25-75 uT.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import reduce
from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from app.geometry import Array
from app.synthetic.steel import Bars, Cuboids, Dipoles

__all__ = ["DEVICE_HEIGHT_M", "SyntheticBuilding", "make_building"]

DEVICE_HEIGHT_M = 1.2
_WALL_M = 1.5  # nobody walks nearer than this to the facade
_BEAM_DROP_M = 0.5  # a slab's beams hang this far below its top
_LEAST_UT, _MOST_UT = 28.0, 70.0  # at the points looked at; between them a little outside
_REACH_M = 3.0  # sources nearer than this to an extreme point are weakened
_MOST_ROUNDS = 12

Steel = Dipoles | Bars | Cuboids


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticBuilding:
    """A building whose field is known exactly.

    The floor plan is [0, width_m] x [0, depth_m]; floor k has its slab's top at `elevations_m[k]`.
    `earth_uT` (3,) is the uniform field in the building frame, `steel` everything else.
    """

    width_m: float
    depth_m: float
    storey_m: float
    elevations_m: tuple[float, ...]
    earth_uT: Array
    steel: tuple[Steel, ...]

    @property
    def walkable_m(self) -> tuple[float, float, float, float]:
        """(x_min, y_min, x_max, y_max) of where people walk, the same on every floor."""
        return _WALL_M, _WALL_M, self.width_m - _WALL_M, self.depth_m - _WALL_M

    def field_uT(self, points_m: Array) -> Array:
        """The field at points (n, 3) of the building frame, uT (n, 3)."""
        p = np.asarray(points_m, dtype=np.float64).reshape(-1, 3)
        return reduce(np.add, (each.field_uT(p) for each in self.steel), np.tile(self.earth_uT, (len(p), 1)))

    def device_grid_m(self, floor: int, spacing_m: float = 1.0) -> Array:
        """Points (ny, nx, 3) over the walkable area of a floor, at device height."""
        x0, y0, x1, y1 = self.walkable_m
        x, y = np.arange(x0, x1 + 1e-9, spacing_m), np.arange(y0, y1 + 1e-9, spacing_m)
        z = np.array([self.elevations_m[floor] + DEVICE_HEIGHT_M])
        yy, xx, zz = np.meshgrid(y, x, z, indexing="ij")
        return np.stack([xx, yy, zz], axis=-1)[:, :, 0]


def make_building(
    rng: np.random.Generator,
    *,
    width_m: float = 40.0,
    depth_m: float = 30.0,
    floors: int = 2,
    storey_m: float = 4.0,
    field_sd_uT: float = 5.0,
    earth_uT: float = 48.0,
    inclination_rad: float = np.deg2rad(60.0),
) -> SyntheticBuilding:
    """Draw a building: beams, columns, rebar, sheets, lifts and appliances, randomly magnetised.

    `field_sd_uT` is the root mean square, over components, of the field's standard deviation at device height.
    The plan must be at least 8 x 8 m. The building's bearing is drawn too.
    """
    assert min(width_m, depth_m) >= 8.0, (width_m, depth_m)
    assert floors >= 1, floors
    bearing = rng.uniform(-np.pi, np.pi)
    horizontal = earth_uT * np.cos(inclination_rad)
    earth = np.array([horizontal * np.cos(bearing), horizontal * np.sin(bearing), -earth_uT * np.sin(inclination_rad)])
    elevations = tuple(storey_m * k for k in range(floors))
    steel = (
        _frame(rng, width_m, depth_m, storey_m, floors),
        _rebar_and_appliances(rng, width_m, depth_m, storey_m, floors),
        _sheets_and_lifts(rng, width_m, depth_m, storey_m, floors),
    )
    raw = SyntheticBuilding(width_m, depth_m, storey_m, elevations, earth, steel)
    return _at_strength(raw, field_sd_uT)


def _frame(rng: np.random.Generator, width_m: float, depth_m: float, storey_m: float, floors: int) -> Bars:
    """The frame: beams along x and y under every slab, columns between slabs; bars whose poles are at the joints."""
    xs, ys = _lines(width_m, 5.0), _lines(depth_m, 5.0)
    ends = list(_frame_bars(xs, ys, storey_m, floors))
    start, end = (np.array(each) for each in zip(*ends, strict=True))
    joint = rng.normal(0.0, 0.25, size=(2, len(start), 3)) * [1.0, 1.0, 0.2]
    length = np.linalg.norm(end - start, axis=1)
    return Bars(start + joint[0], end + joint[1], _strengths(rng, len(start)) * 8.0 * np.sqrt(length / 5.0))


def _frame_bars(xs: Array, ys: Array, storey_m: float, floors: int) -> Iterator[tuple[list[float], list[float]]]:
    for slab in range(floors + 1):
        z = slab * storey_m - _BEAM_DROP_M
        for y in ys:
            yield from (([a, y, z], [b, y, z]) for a, b in pairwise(xs))
        for x in xs:
            yield from (([x, a, z], [x, b, z]) for a, b in pairwise(ys))
        if slab < floors:
            yield from (([x, y, z], [x, y, z + storey_m]) for x in xs for y in ys)


def _rebar_and_appliances(
    rng: np.random.Generator, width_m: float, depth_m: float, storey_m: float, floors: int
) -> Dipoles:
    """Rebar bundles scattered in every slab; radiators, switchboards and ducts on the walls and under the ceilings."""
    area = width_m * depth_m
    in_slabs, on_walls, overhead = max(4, int(area / 8.0)), max(4, int(area / 80.0)), max(3, int(area / 100.0))
    position, moment = [], []
    for slab in range(floors + 1):
        xy = rng.uniform([0.0, 0.0], [width_m, depth_m], size=(in_slabs, 2))
        position.append(np.column_stack([xy, slab * storey_m - rng.uniform(0.1, 0.3, in_slabs)]))
        moment.append(_directions(rng, in_slabs) * _strengths(rng, in_slabs)[:, None] * 4.0)
    for floor in range(floors):
        position.append(_along_walls(rng, on_walls, width_m, depth_m, floor * storey_m))
        moment.append(_directions(rng, on_walls) * _strengths(rng, on_walls)[:, None] * 7.0)
        xy = rng.uniform([0.0, 0.0], [width_m, depth_m], size=(overhead, 2))
        position.append(np.column_stack([xy, floor * storey_m + rng.uniform(2.8, 3.2, overhead)]))
        moment.append(_directions(rng, overhead) * _strengths(rng, overhead)[:, None] * 18.0)
    return Dipoles(np.concatenate(position), np.concatenate(moment))


def _along_walls(rng: np.random.Generator, n: int, width_m: float, depth_m: float, elevation_m: float) -> Array:
    """`n` points within 0.3 m of the facade."""
    along = rng.uniform(0.0, 2.0 * (width_m + depth_m), n)
    inset = rng.uniform(0.0, 0.3, n)
    corners = np.cumsum([0.0, width_m, depth_m, width_m])
    side = np.searchsorted(corners, along, side="right") - 1
    s = along - corners[side]
    x = np.choose(side, [s, width_m - inset, width_m - s, inset])
    y = np.choose(side, [inset, s, depth_m - inset, depth_m - s])
    return np.column_stack([x, y, elevation_m + rng.uniform(0.4, 1.8, n)])


def _sheets_and_lifts(
    rng: np.random.Generator, width_m: float, depth_m: float, storey_m: float, floors: int
) -> Cuboids:
    """Steel sheets in the slabs (two a slab) and two lift cars outside the facade."""
    sheets, lifts = 2 * (floors + 1), 2
    size = np.column_stack([rng.uniform(2.5, 6.0, (sheets, 2)), np.full(sheets, 0.004)])
    z = np.repeat(np.arange(floors + 1), 2) * storey_m - 0.35
    xy = rng.uniform([3.0, 3.0], [width_m - 3.0, depth_m - 3.0], size=(sheets, 2))
    sheet_polarisation = _directions(rng, sheets) * [1.0, 1.0, 0.1] * _strengths(rng, sheets)[:, None] * 15000.0
    lift_xy = np.column_stack([rng.uniform(3.0, width_m - 3.0, lifts), [-1.2, depth_m + 1.2]])
    lift_z = rng.integers(0, floors, lifts) * storey_m + 1.1
    lift_polarisation = _directions(rng, lifts) * _strengths(rng, lifts)[:, None] * 50.0
    return Cuboids(
        np.concatenate([np.column_stack([xy, z]), np.column_stack([lift_xy, lift_z])]),
        np.concatenate([size, np.tile([1.6, 1.4, 2.2], (lifts, 1))]),
        np.concatenate([sheet_polarisation, lift_polarisation]),
    )


def _at_strength(raw: SyntheticBuilding, field_sd_uT: float) -> SyntheticBuilding:
    """The building at the standard deviation asked for, its steel weakened where |B| would leave the usual range."""
    spacing_m = max(1.0, np.sqrt(raw.width_m * raw.depth_m / 3000.0))
    points = np.concatenate([raw.device_grid_m(k, spacing_m).reshape(-1, 3) for k in range(len(raw.elevations_m))])
    building = raw
    for _ in range(_MOST_ROUNDS):
        B = building.field_uT(points)
        sd = np.sqrt(np.mean([np.var(each, axis=0) for each in np.split(B, len(raw.elevations_m))]))
        building = replace(building, steel=tuple(each.scaled(field_sd_uT / sd) for each in building.steel))
        norm = np.linalg.norm(raw.earth_uT + (B - raw.earth_uT) * field_sd_uT / sd, axis=1)
        extreme = (norm < _LEAST_UT) | (norm > _MOST_UT)
        if not extreme.any():
            break
        near = cKDTree(points[extreme])
        weakened = (
            each.scaled(np.where(near.query(each.position_m)[0] < _REACH_M, 0.7, 1.0)) for each in building.steel
        )
        building = replace(building, steel=tuple(weakened))
    return building


def _lines(length_m: float, spacing_m: float) -> Array:
    """Grid lines from wall to wall, near `spacing_m` apart."""
    return np.linspace(0.0, length_m, max(2, round(length_m / spacing_m) + 1))


def _strengths(rng: np.random.Generator, n: int) -> Array:
    """Relative strengths of either sign, without long tails: uniform in +-[0.4, 1.4]."""
    return np.asarray(rng.uniform(0.4, 1.4, n) * rng.choice([-1.0, 1.0], n))


def _directions(rng: np.random.Generator, n: int) -> Array:
    """(n, 3) directions, uniform on the sphere."""
    v = rng.normal(size=(n, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))
