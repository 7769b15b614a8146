"""What a grid loses between its cells: values there are interpolated, and a field bends."""

import numpy as np
from scipy.spatial.distance import cdist

from app.errors import InvalidInput
from app.field.kernels import covariance

__all__ = ["interpolation_ratio"]

LARGEST_RATIO = 0.5
"""Of the signal's variance: a coarser grid tells little between its cells."""
_PLACES = (np.arange(4) + 0.5) / 4.0


def interpolation_ratio(length_m: float, resolution_m: float) -> float:
    """Mean over a cell of the variance of a field about what lies on straight lines between the cell's corners, over

    the field's variance: `k(0) - 2 w^T k + w^T K w` of the bilinear weights w. The field is taken to bend smoothly
    (Matern 5/2), as fields some way from the steel do. Raises InvalidInput for a grid too coarse to be of use.
    """
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)])
    u, v = (each.ravel() for each in np.meshgrid(_PLACES, _PLACES))
    weights = np.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v], axis=1)
    in_lengths = length_m / resolution_m
    among = covariance("matern52", cdist(corners, corners), in_lengths)
    to = covariance("matern52", cdist(np.column_stack([u, v]), corners), in_lengths)
    ratio = 1.0 - 2.0 * np.sum(weights * to, axis=1) + np.einsum("ni,ij,nj->n", weights, among, weights)
    mean = max(float(ratio.mean()), 0.0)
    if mean > LARGEST_RATIO:
        raise InvalidInput(
            f"resolution_m {resolution_m:g} is too coarse for this field, which changes within {length_m:.2g} m: "
            f"ask for {0.5 * length_m:.2g} or less"
        )
    return mean
