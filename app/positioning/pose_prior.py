"""What is known of a window's position before it is matched."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput

__all__ = ["LEAST_PRIOR_SD_M", "PosePrior"]

LEAST_PRIOR_SD_M = 1e-3


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Gaussian prior of the last sample's position, metres; no position: flat.

    walkable: per plane (ny, nx), the cells the last sample may be in, or None for all

    Raises InvalidInput for an sd below a millimetre.
    """

    position_m: tuple[float, float, float] | None = None
    sd_m: float = 1.0
    walkable: Sequence[NDArray[np.bool_]] | None = None

    def __post_init__(self) -> None:
        if not self.sd_m >= LEAST_PRIOR_SD_M:
            raise InvalidInput(
                f"the prior's sd_m is {self.sd_m:g}: no position is known that well; give at least "
                f"{LEAST_PRIOR_SD_M:g} m",
                Fault("/prior/sd_m", f"must be at least {LEAST_PRIOR_SD_M:g}"),
            )
