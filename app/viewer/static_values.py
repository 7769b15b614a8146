"""The numbers of a map inside its static page: every cell's mean, sd and layers, small enough to carry in a file.

A value is a whole number of steps above the lowest, in 16 bits, 0 where nothing is known; numbers are stored as
differences from the cell before, deflated and written in base64. `static/readout.js` reads them.
"""

import zlib
from base64 import b64encode
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.field.grid import FieldGrid
from app.geometry import Array

__all__ = ["MAX_CELLS", "LayerPictures", "pack", "packed_values", "thinned_grid"]

MAX_CELLS = 240_000  # of all heights together: with every layer, about ten megabytes of page
_FIELD_STEP_UT = 0.01
_LAYER_STEPS = 1000  # from the low to the high end of a layer's colours
_MOST = 65_535
_HELD_ALREADY = frozenset({"norm", "bx", "by", "bz", "horizontal", "vertical", "sd", "measured"})


@dataclass(frozen=True, slots=True, eq=False)
class LayerPictures:
    """A layer of the shown cells at every height: values (nz, ny, nx), NaN where unknown, and its scale's ends."""

    values: Array
    low: float
    high: float


def thinned_grid(grid: FieldGrid, max_cells: int = MAX_CELLS) -> tuple[FieldGrid, int]:
    """The grid of every n-th cell in x and y, and n: 1 unless all heights together have more than `max_cells`."""
    n = 1
    while grid.measured[:, ::n, ::n].size > max_cells:
        n += 1
    if n == 1:
        return grid, 1
    every = np.s_[:, ::n, ::n]
    fewer = replace(
        grid,
        resolution_m=n * grid.resolution_m,
        mean_uT=grid.mean_uT[every],
        sd_uT=grid.sd_uT[every],
        gradient_uT_per_m=grid.gradient_uT_per_m[every],
        measured=grid.measured[every],
    )
    return fewer, n


def packed_values(grid: FieldGrid, layers: dict[str, LayerPictures]) -> list[dict[str, object]]:
    """Per height: `mean` and `sd` (uT) of every component, and those layers that cannot be reckoned from them."""
    told: list[dict[str, object]] = []
    for k, measured in enumerate(grid.measured):
        mean, sd = (
            [pack(np.where(measured, values[k, ..., c], np.nan), _FIELD_STEP_UT) for c in range(values.shape[-1])]
            for values in (grid.mean_uT, grid.sd_uT)
        )
        others = {
            name: pack(layer.values[k], (layer.high - layer.low) / _LAYER_STEPS)
            for name, layer in layers.items()
            if name not in _HELD_ALREADY
        }
        told.append({"mean": mean, "sd": sd, "layers": others})
    return told


def pack(values: NDArray[np.floating], step: float) -> dict[str, object]:
    """Values (ny, nx), NaN where unknown, as {low, step, data}: right to half a step, which grows for a wide range.

    A few values far above the rest are told as the highest number there is.
    """
    known = np.isfinite(values)
    found = values[known].astype(np.float64)
    low = float(found.min()) if len(found) else 0.0
    far = float(np.percentile(found, 99.9)) - low if len(found) else 0.0
    step = max(step, far / (_MOST - 2))
    codes = np.zeros(values.shape, dtype=np.uint16)
    codes[known] = np.clip(np.round((found - low) / step) + 1, 1, _MOST).astype(np.uint16)
    steps = np.diff(codes.ravel(), prepend=np.uint16(0)).astype("<u2")  # modulo 2^16
    return {"low": low, "step": step, "data": b64encode(zlib.compress(steps.tobytes(), 9)).decode()}
