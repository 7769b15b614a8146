"""What a magnetometer's calibration is: a hard iron and a matrix that undoes everything else."""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array

__all__ = ["SensorModel"]


@dataclass(frozen=True, slots=True, eq=False)
class SensorModel:
    """`B_true = correction (B_measured - hard_iron)`, all in the sensor's axes (Shockley, Eqs. 2.6, 2.22).

    hard_iron_uT (3,) holds the sensor's own offset too; correction (3, 3) is the inverse of scale factors,
    non-orthogonality and soft iron together.
    """

    hard_iron_uT: Array
    correction: Array

    def apply(self, B_uT: Array) -> Array:
        """Readings (n, 3) or (3,), uT, as a perfect sensor with these axes would have given them."""
        return np.asarray((B_uT - self.hard_iron_uT) @ self.correction.T)

    def distort(self, B_uT: Array) -> Array:
        """What this sensor reads, without noise, in a true field (n, 3) or (3,) in its axes, uT."""
        return np.asarray(B_uT @ np.linalg.inv(self.correction).T + self.hard_iron_uT)
