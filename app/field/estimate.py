"""What an engine gives back: the field on the cells of a grid, and every survey predicted from the others."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from app.field.observations import Walk
from app.field.raster import GridFrame
from app.field.tile_fit import FitState
from app.field.tiles import REACH_M
from app.geometry import Array

__all__ = ["FieldEstimate", "ambient_field_uT"]


@dataclass(frozen=True, slots=True, eq=False)
class FieldEstimate:
    """ambient_uT (c,); mean_uT (c, nz, ny, nx) about it; variance_ratio of the latent field over the prior's variance

    (c, nz, ny, nx), or (1, nz, ny, nx) when it is the same for all; gradient_uT_per_m (d, c, nz, ny, nx) over x, y and,
    where the field was fitted in three dimensions, z; prior_sd_uT (c,)
    error_sd_uT (c,): of one observation about the latent field
    held_out_mean_uT (n, c), held_out_variance_ratio (n, c) or (n, 1): each survey's observations, by survey id,
    predicted from all the other surveys
    discredited: surveys so much noisier than the others that they say nothing of the next one's errors
    reach_up_m: how far above and below the surveys it is believed
    state: what the next fit can start from; tiles_refitted of all tiles; continued: with what an earlier
    fit had learned
    """

    frame: GridFrame
    ambient_uT: Array
    mean_uT: Array
    variance_ratio: Array
    gradient_uT_per_m: Array
    prior_sd_uT: Array
    error_sd_uT: Array
    held_out_mean_uT: Mapping[str, Array]
    held_out_variance_ratio: Mapping[str, Array]
    hyperparameters: dict[str, object]
    discredited: frozenset[str] = frozenset()
    reach_up_m: float = REACH_M
    state: FitState | None = None
    tiles_refitted: int = 0
    continued: bool = False


def ambient_field_uT(walks: Sequence[Walk]) -> Array:
    """(c,) the field far from all steel, as far as the walks know it: their median."""
    return np.asarray(np.median(np.concatenate([walk.field_uT for walk in walks]), axis=0))
