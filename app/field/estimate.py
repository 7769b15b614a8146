"""What an engine gives back: the field on the cells of a grid, and every survey predicted from the others."""

from collections.abc import Mapping
from dataclasses import dataclass

from app.field.raster import GridFrame
from app.geometry import Array

__all__ = ["FieldEstimate"]


@dataclass(frozen=True, slots=True, eq=False)
class FieldEstimate:
    """mean_uT (c, ny, nx) about the ambient field, variance_ratio of the latent field over the prior's variance
    (c, ny, nx) or (1, ny, nx), gradient_uT_per_m (2, c, ny, nx), prior_sd_uT (c,)

    error_sd_uT (c,): of one observation about the latent field
    held_out_mean_uT (n, c), held_out_variance_ratio (n, c) or (n, 1): each survey's observations, by survey id,
    predicted from all the other surveys
    """

    frame: GridFrame
    mean_uT: Array
    variance_ratio: Array
    gradient_uT_per_m: Array
    prior_sd_uT: Array
    error_sd_uT: Array
    held_out_mean_uT: Mapping[str, Array]
    held_out_variance_ratio: Mapping[str, Array]
    hyperparameters: dict[str, object]
