"""The maps of the floors as the filter reads them: features, their variance, and whether anything was measured.

Every floor is one or more planes (its map's heights); all planes lie in one flat array, cell after cell, for the
compiled loops. Features and scaling are those of the search (`app.positioning.floors`): both judge a place alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.field.error_structure import ErrorStructure, strictest
from app.field.samples import Components
from app.geometry import Array
from app.positioning.features import reduce_field, reduce_variance
from app.positioning.floors import Plane, SearchableFloor
from app.positioning.off_map import process_prior

__all__ = ["Places", "make_places"]


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Floors, in order, made ready to be looked up.

    cells         flat float32; a cell holds its c features, the variance of one measurement about them, and 1 or 0:
                  measured or not
    planes        (p, 3) of each plane: x and y of its first cell, metres, and its height
    shapes        (p, 3) its first index in `cells`, ny, nx
    floors        (f, 2) first plane of a floor, and how many it has
    resolution_m  (p,)
    heights_m     (f,) where a device is held on each floor: the height of its map's middle plane
    lowest_m, highest_m   (f,) of its map
    errors        (5,) walk share, white share, 1 / walk length; sd of the field where nothing is mapped, and 1 / its
                  correlation length
    prior_variance_uT2, ambient_uT   (c,) the field where nothing is mapped
    typical_variance_uT2             median over what is measured
    """

    components: Components
    scale: Array
    cells: NDArray[np.float32]
    planes: Array
    shapes: NDArray[np.int64]
    floors: NDArray[np.int64]
    resolution_m: Array
    heights_m: Array
    lowest_m: Array
    highest_m: Array
    errors: Array
    ambient_uT: Array
    prior_variance_uT2: Array
    typical_variance_uT2: float
    structure: ErrorStructure

    @property
    def count(self) -> int:
        """Of floors."""
        return len(self.floors)


def make_places(floors: Sequence[SearchableFloor]) -> Places:
    """Places of floors that all hold the same components under the noise they share."""
    structure = strictest([floor.grid.error_structure for floor in floors])
    planes = [(floor, layer, plane) for floor in floors for layer, plane in enumerate(floor.planes)]
    blocks = [_cells(*each) for each in planes]
    starts = np.concatenate([[0], np.cumsum([block.size for block in blocks])])
    counts = np.array([len(floor.planes) for floor in floors])
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    best = max(planes, key=lambda each: int(each[2].measured.sum()))
    variance = _prior_variance(best[0], best[2])
    process = process_prior(best[2], variance)
    return Places(
        components=floors[0].components,
        scale=planes[0][2].scale,
        cells=np.concatenate([block.ravel() for block in blocks]),
        planes=np.array([(*plane.origin_m, plane.height_m) for _, _, plane in planes]),
        shapes=np.array([(start, *plane.shape) for start, (_, _, plane) in zip(starts[:-1], planes, strict=True)]),
        floors=np.stack([first, counts], axis=1).astype(np.int64),
        resolution_m=np.array([plane.resolution_m for _, _, plane in planes]),
        heights_m=np.array([floor.planes[len(floor.planes) // 2].height_m for floor in floors]),
        lowest_m=np.array([floor.planes[0].height_m for floor in floors]),
        highest_m=np.array([floor.planes[-1].height_m for floor in floors]),
        errors=np.array([
            structure.walk_share, structure.white_share, 1.0 / structure.walk_length_m,
            float(np.sqrt(np.mean(variance))), 1.0 / process.length_m,
        ]),
        ambient_uT=best[2].ambient_uT,
        prior_variance_uT2=variance,
        typical_variance_uT2=float(np.mean([plane.typical_variance_uT2 for _, _, plane in planes])),
        structure=structure,
    )  # fmt: skip


def _prior_variance(floor: SearchableFloor, plane: Plane) -> Array:
    grid = floor.grid
    variance = reduce_variance(grid.ambient_uT, np.square(grid.prior_sd_uT), grid.components, floor.components)
    return np.asarray(np.square(plane.scale) * variance)


def _cells(floor: SearchableFloor, layer: int, plane: Plane) -> NDArray[np.float32]:
    """(ny, nx, c + 2) of one plane."""
    grid, measured = floor.grid, plane.measured
    mean = np.where(measured[..., None], grid.mean_uT[layer], grid.ambient_uT).astype(np.float64)
    sd = np.where(measured[..., None], grid.sd_uT[layer], 0.0).astype(np.float64)
    variance = reduce_variance(mean, np.square(sd) + np.square(floor.noise_sd_uT), grid.components, floor.components)
    features = plane.scale * reduce_field(mean, grid.components, floor.components)
    spread = np.mean(np.square(plane.scale) * variance, axis=-1)
    return np.concatenate([features, spread[..., None], measured[..., None]], axis=-1).astype(np.float32)
