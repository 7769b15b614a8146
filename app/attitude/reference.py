"""What the magnetometer is compared with: Kuevor's four references, a level one, and a field that is learned.

no reference      `None`                        gyro and accelerometer only (Kuevor's first row)
constant          `constant_reference`          the world model, or one point of a map
a map             `map_reference`               the map where the device is, its variance, and that of the place
level             `level_reference`             horizontal and vertical strength: yaw counts from magnetic north
learned           `learned_reference`           nothing known: strength, dip and hard iron come from the samples
"""

from dataclasses import dataclass

import numpy as np

from app.errors import Fault, InvalidInput
from app.field.grid import FieldGrid
from app.geometry import Array

__all__ = [
    "MagneticReference",
    "constant_reference",
    "grid_reference",
    "learned_reference",
    "level_reference",
    "map_reference",
]


@dataclass(frozen=True, slots=True, eq=False)
class MagneticReference:
    """B_uT (n, 3) at every sample or (3,) for all, building frame, NaN rows where nothing is known; None: learned.

    variance_uT2 (3,) or (n, 3) per component, or (3, 3), (n, 3, 3) whole; of the reference alone, zero for none.
    """

    B_uT: Array | None
    variance_uT2: Array | float = 0.0

    def rows(self, n: int) -> tuple[Array, Array]:
        """(n or 1, 3) and (n or 1, 3, 3) for n samples; raises InvalidInput where the shapes do not fit."""
        B = np.zeros((1, 3)) if self.B_uT is None else np.atleast_2d(np.asarray(self.B_uT, dtype=np.float64))
        if B.shape not in ((n, 3), (1, 3)):
            message = f"the reference has shape {B.shape}: give (3,) or a row of three for each of {n} samples"
            raise InvalidInput(message, Fault("/reference/B_uT", "shape"))
        variance = _matrices(np.asarray(self.variance_uT2, dtype=np.float64), n)
        if variance.shape not in ((n, 3, 3), (1, 3, 3)):
            message = (
                f"the reference's variance has shape {np.shape(self.variance_uT2)}: give (3,), (n, 3) or (n, 3, 3)"
            )
            raise InvalidInput(message, Fault("/reference/variance_uT2", "shape"))
        unknown = np.asarray(~np.isfinite(variance).all(axis=(1, 2)))
        if unknown.any():
            if len(variance) == 1:
                raise InvalidInput("the reference's variance is not finite", Fault("/reference/variance_uT2", "finite"))
            B = np.where(unknown[:, None], np.nan, B)
        return np.ascontiguousarray(B), np.ascontiguousarray(variance)


def _matrices(variance: Array, n: int) -> Array:
    if variance.ndim == 0:
        return np.asarray(variance * np.eye(3)[None])
    if variance.shape in ((3, 3), (n, 3, 3)) and not (variance.shape == (n, 3) and n == 3):
        return variance.reshape(-1, 3, 3)
    if variance.shape in ((3,), (n, 3)):
        return np.asarray(np.atleast_2d(variance)[:, :, None] * np.eye(3))
    return variance


def learned_reference() -> MagneticReference:
    """Nothing known of the field but that it is one field: yaw counts from its azimuth."""
    return MagneticReference(None)


def constant_reference(B_uT: Array, sd_uT: float = 0.0) -> MagneticReference:
    """One vector (3,) for all samples: the world magnetic model, or one point of a map (Kuevor, L1313)."""
    return MagneticReference(np.asarray(B_uT, dtype=np.float64).reshape(3), sd_uT**2)


def level_reference(horizontal_uT: float, vertical_uT: float, sd_uT: float = 0.0) -> MagneticReference:
    """Strengths alone, vertical up: the building's x axis is then magnetic north, and yaw is counted from it."""
    return MagneticReference(np.array([horizontal_uT, 0.0, vertical_uT]), sd_uT**2)


def grid_reference(grid: FieldGrid, p_building_m: Array, position_covariance_m2: Array) -> MagneticReference:
    """A map at places (n, 3) uncertain by a covariance (2, 2) along the floor; nothing is known where unmapped."""
    values = grid.at(p_building_m)
    mean_uT = np.where(values.measured[:, None], values.mean_uT, np.nan)
    sd_uT = np.hypot(values.sd_uT, grid.noise_sd_uT)
    return map_reference(mean_uT, sd_uT, values.gradient_uT_per_m[:, :, :2], position_covariance_m2)


def map_reference(
    mean_uT: Array, sd_uT: Array, gradient_uT_per_m: Array | None = None, position_covariance_m2: Array | None = None
) -> MagneticReference:
    """The map where the device is: mean (n, 3), sd (n, 3), and what an uncertain place adds, J P J^T (Kuevor, B20).

    gradient_uT_per_m (n, 3, d), derivative of component i along axis j, of x and y or of all three;
    position_covariance_m2 (d, d) or (n, d, d).
    """
    variance = np.square(sd_uT)[:, :, None] * np.eye(3)
    if gradient_uT_per_m is not None and position_covariance_m2 is not None:
        J = gradient_uT_per_m
        variance = variance + J @ position_covariance_m2 @ J.transpose(0, 2, 1)
    return MagneticReference(np.asarray(mean_uT, dtype=np.float64), variance)
