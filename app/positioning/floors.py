"""A floor made ready for searching: its field as features, padded with the prior, under min/max pyramids."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.field.grid import FieldGrid
from app.field.pyramid import Pyramid, build_pyramid
from app.field.samples import Components
from app.geometry import Array
from app.positioning.features import reduce_field, reduce_variance

__all__ = [
    "TOP_LEVEL", "Plane", "SearchableFloor", "feature_scale", "prepare_floor", "prepare_floors", "reduce_floor",
    "shared_noise_sd_uT",
]  # fmt: skip

TOP_LEVEL = 5  # the search starts from blocks of 2^5 cells
CELL_SHARE = 0.25  # of the squared change from cell to cell: places are rounded twice, by up to half a cell per axis
_ENOUGH_CELLS = 40_000  # of a map to know how steep it is
Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """One layer of a floor's grid, as features.

    mean_uT                (ny + 2, nx + 2, c) features of the field times `scale`, one cell of prior on each side;
                           unmeasured cells hold the prior
    variance_uT2           (ny + 2, nx + 2) variance of one measurement about them: map sd, the floor's noise, and what
                           the field varies within a cell; one figure for all components, which `scale` makes alike
    measured               (ny, nx)
    scale                  (c,) factor of each component: the horizontal ones keep their microteslas, the vertical is
                           stretched to their noise
    ambient_uT, off_map_variance_uT2   (c,) and a number: the same where there is no map
    typical_variance_uT2   median variance over the measured cells, without what the field varies within them
    searched_variance_uT2  median of variance_uT2
    gradient_uT_per_m      rms gradient of the features over the measured cells, components and axes together
    """

    height_m: float
    origin_m: tuple[float, float]
    resolution_m: float
    mean_uT: Float32
    variance_uT2: Float32
    measured: NDArray[np.bool_]
    scale: Array
    ambient_uT: Array
    off_map_variance_uT2: float
    typical_variance_uT2: float
    searched_variance_uT2: float
    gradient_uT_per_m: float
    pyramid: Pyramid

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) cells."""
        return self.measured.shape[0], self.measured.shape[1]

    @property
    def nbytes(self) -> int:
        return self.mean_uT.nbytes + self.variance_uT2.nbytes + self.measured.nbytes + self.pyramid.nbytes


@dataclass(frozen=True, slots=True, eq=False)
class SearchableFloor:
    """A floor's map and what the search needs of it; immutable, to be cached behind the map's content hash and noise.

    noise_sd_uT  (c_grid,) sd of one measurement about the field, per component of the grid: the map's own noise, or
                 the one shared with the floors it is compared with
    """

    floor_id: str
    grid: FieldGrid
    components: Components
    noise_sd_uT: Array
    planes: tuple[Plane, ...]

    @property
    def nbytes(self) -> int:
        """Bytes held, the grid's included: about 190 per cell with three components."""
        return self.grid.nbytes + sum(plane.nbytes for plane in self.planes)


def prepare_floor(floor_id: str, grid: FieldGrid, noise_sd_uT: Array | None = None) -> SearchableFloor:
    """Planes and pyramids of a map with its own components: tens of milliseconds per 100 x 100 m at 0.25 m.

    `noise_sd_uT` (c,) replaces the noise the map learned, for floors that are compared with each other.
    """
    return _prepare(floor_id, grid, grid.components, grid.noise_sd_uT if noise_sd_uT is None else noise_sd_uT)


def prepare_floors(grids: Mapping[str, FieldGrid]) -> list[SearchableFloor]:
    """Floors, by id, that are to be searched together: all under the noise they share."""
    noise_sd_uT = shared_noise_sd_uT(list(grids.values()))
    return [prepare_floor(floor_id, grid, noise_sd_uT) for floor_id, grid in grids.items()]


def shared_noise_sd_uT(grids: Sequence[FieldGrid]) -> Array | None:
    """The noise (c,) under which maps are compared: per component the largest that one of them claims.

    None (each keeps its own) for one map alone and for maps of different components.

    A likelihood rewards the map that claims the least noise wherever residuals are small, and forgives most where the
    claim is large, so that floors would be told apart by what their maps claim instead of by the field.
    """
    if len(grids) < 2 or len({grid.components for grid in grids}) > 1:
        return None
    return np.asarray(np.max([grid.noise_sd_uT for grid in grids], axis=0))


def reduce_floor(floor: SearchableFloor, components: Components, noise_sd_uT: Array | None = None) -> SearchableFloor:
    """The same floor on poorer features (Kuevor B12 for the norm) or under another noise (c_grid,) of the grid's own
    components; itself when it is already so."""
    noise = floor.noise_sd_uT if noise_sd_uT is None else noise_sd_uT
    if floor.components == components and np.array_equal(noise, floor.noise_sd_uT):
        return floor
    return _prepare(floor.floor_id, floor.grid, components, noise)


def _prepare(floor_id: str, grid: FieldGrid, components: Components, noise_sd_uT: Array) -> SearchableFloor:
    planes = tuple(_plane(grid, layer, components, noise_sd_uT) for layer in range(len(grid.heights_m)))
    return SearchableFloor(floor_id, grid, components, noise_sd_uT, planes)


def _plane(grid: FieldGrid, layer: int, components: Components, noise_sd_uT: Array) -> Plane:
    source, measured = grid.components, grid.measured[layer]
    noise = np.square(noise_sd_uT)
    scale = feature_scale(reduce_variance(grid.ambient_uT, noise, source, components), components)
    mean = np.where(measured[..., None], grid.mean_uT[layer], grid.ambient_uT).astype(np.float64)
    sd = np.where(measured[..., None], grid.sd_uT[layer], grid.prior_sd_uT).astype(np.float64)
    variance = _alike(reduce_variance(mean, np.square(sd) + noise, source, components), scale)
    ambient = scale * reduce_field(grid.ambient_uT, source, components)
    off_map = float(_alike(reduce_variance(grid.ambient_uT, np.square(grid.prior_sd_uT) + noise, source, components),
                           scale))  # fmt: skip
    cells = scale * reduce_field(mean, source, components)
    features = _padded(cells, ambient)
    spread = _padded(variance + CELL_SHARE * _change_of_a_cell_uT2(cells), off_map)
    known = variance[measured]
    return Plane(
        height_m=float(grid.heights_m[layer]),
        origin_m=grid.origin_m,
        resolution_m=grid.resolution_m,
        mean_uT=features,
        variance_uT2=spread,
        measured=measured,
        scale=scale,
        ambient_uT=ambient,
        off_map_variance_uT2=off_map,
        typical_variance_uT2=float(np.median(known)) if len(known) else off_map,
        searched_variance_uT2=float(np.median(spread)),
        gradient_uT_per_m=_rms_gradient(cells, measured, grid.resolution_m),
        pyramid=build_pyramid(features, spread, TOP_LEVEL),
    )


def _change_of_a_cell_uT2(cells: Array) -> Array:
    """(ny, nx) mean square over components of the change from a cell to the next, both axes together."""
    change = np.zeros(cells.shape[:2])
    for axis in (0, 1):
        if cells.shape[axis] > 1:
            change += np.mean(np.square(np.gradient(cells, axis=axis)), axis=-1)
    return change


def feature_scale(noise_uT2: Array, components: Components) -> Array:
    """(c,) factors that give every component the noise of the horizontal ones, from variances (c,)."""
    if components == "norm":
        return np.ones(1)
    horizontal = float(np.mean(noise_uT2[:-1]))
    vertical = float(np.sqrt(max(horizontal, 1e-6) / max(float(noise_uT2[-1]), 1e-6)))
    return np.append(np.ones(len(noise_uT2) - 1), vertical)


def _alike(variance_uT2: Array, scale: Array) -> Array:
    """(...) one variance for all scaled components: the mean of theirs (..., c)."""
    return np.asarray(np.maximum(np.mean(np.square(scale) * variance_uT2, axis=-1), 1e-6))


def _padded(cells: Array, prior: Array | float) -> Float32:
    ny, nx, *c = cells.shape
    padded = np.empty((ny + 2, nx + 2, *c), dtype=np.float32)
    padded[:] = prior
    padded[1:-1, 1:-1] = cells
    return padded


def _rms_gradient(cells: Array, measured: NDArray[np.bool_], resolution_m: float) -> float:
    """Root of the mean squared gradient (summed over components and axes) between measured neighbours, uT/m.

    Of large maps some rows and columns are enough.
    """
    stride = max(1, int(np.sqrt(measured.size / _ENOUGH_CELLS)))
    squared = 0.0
    for axis in (0, 1):
        here, there = (slice(None), slice(-1)), (slice(None), slice(1, None))
        one, next_one = (here, there) if axis else (here[::-1], there[::-1])
        both = measured[one] & measured[next_one]
        both[np.arange(len(both)) % stride != 0] = False
        if both.any():
            squared += float(np.mean(np.sum(np.square(cells[next_one][both] - cells[one][both]), axis=1)))
    return float(np.sqrt(squared)) / resolution_m
