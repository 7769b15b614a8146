"""A map as named variables on named dimensions with the attributes of the CF conventions: what every export is made of.

The building's frame is a plan of its own, not on the Earth: x and y are metres along the plan's axes, z metres upward,
so there is no grid mapping and no standard name for them. The CF standard names know no magnetic flux density either;
`long_name` says what a variable is, `units` are those of UDUNITS.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.field.expected_error import WindowModel, expected_error_m, point_information
from app.field.grid import FieldGrid
from app.field.localizability import gradient_norms

__all__ = ["AXES", "MapDataset", "Variable", "map_dataset"]

AXES = ("z", "y", "x")
NOTHING: Mapping[str, NDArray[np.floating]] = {}

_FIELD = {
    "bx": "magnetic flux density along the plan's x axis",
    "by": "magnetic flux density along the plan's y axis",
    "bz": "magnetic flux density upward",
    "horizontal": "horizontal magnitude of the magnetic flux density",
    "vertical": "magnetic flux density upward",
    "norm": "magnitude of the magnetic flux density",
}
_LAYERS = {
    "coverage": "number of surveys within one metre",
    "conflict": "errors of left-out surveys over their stated standard deviation",
}


@dataclass(frozen=True, slots=True, eq=False)
class Variable:
    """Values with the names of their dimensions; attributes are strings, numbers and lists of numbers."""

    dimensions: tuple[str, ...]
    values: NDArray[Any]
    attributes: dict[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class MapDataset:
    """variables: z, y, x (n,) float64 and their bounds; measured (nz, ny, nx) int8; data (nz, ny, nx) float32, NaN
    where nothing was measured: per component the mean, its sd and, when asked for, its slopes; then what tells places
    apart, when asked for, and further layers.
    """

    attributes: dict[str, Any]
    variables: dict[str, Variable]

    @property
    def data(self) -> dict[str, Variable]:
        """The variables on cells, without the mask."""
        return {name: v for name, v in self.variables.items() if v.dimensions == AXES and name != "measured"}


def map_dataset(
    grid: FieldGrid,
    map_id: str,
    layers: Mapping[str, NDArray[np.floating]] = NOTHING,
    gradient: bool = True,
    localizability: bool = False,
) -> MapDataset:
    """The whole map. `map_id`: what names it for ever; `layers`: (nz, ny, nx) each, by name."""
    mask = {
        "measured": Variable(AXES, grid.measured.astype(np.int8), {
            "long_name": "whether a survey came close enough for the field to be known", "standard_name": "status_flag",
            "flag_values": np.array([0, 1], np.int8), "flag_meanings": "not_measured measured", "coordinates": "z y x",
        })
    }  # fmt: skip
    fields: dict[str, Variable] = {}
    for c, component in enumerate(grid.component_names):
        fields |= _component(grid, c, component, gradient)
    if localizability:
        fields |= _localizability(grid, WindowModel())
    for name, layer in layers.items():
        fields[name] = _on_cells(grid, layer, _LAYERS.get(name, name), "1", "measured")
    return MapDataset(_about(grid, map_id), _axes(grid) | mask | fields)


def _component(grid: FieldGrid, c: int, component: str, gradient: bool) -> dict[str, Variable]:
    """Mean, sd and slopes of one component."""
    mean, sd, long_name = f"{component}_ut", f"{component}_sd_ut", _FIELD[component]
    found = {
        mean: _on_cells(grid, grid.mean_uT[..., c], long_name, "uT", f"{sd} measured"),
        sd: _on_cells(grid, grid.sd_uT[..., c], f"standard deviation of {long_name}", "uT", "measured"),
    }
    slopes = grid.gradient_uT_per_m[..., c, :]
    for axis in range(slopes.shape[-1] if gradient else 0):  # with x and y; with z where the map knows it
        name, what = f"d{component}_d{'xyz'[axis]}_ut_per_m", f"derivative with {'xyz'[axis]} of {long_name}"
        found[name] = _on_cells(grid, slopes[..., axis], what, "uT m-1", "measured")
    return found


def _localizability(grid: FieldGrid, window: WindowModel) -> dict[str, Variable]:
    """How well places are told apart: norms of the gradient along the floor, and what they are worth to a window."""
    norms = gradient_norms(grid.gradient_uT_per_m[..., :2])
    layers = range(len(grid.heights_m))
    information = np.stack([point_information(grid, k, window.noise_uT) for k in layers])
    error_m = np.stack([expected_error_m(grid, k, window) for k in layers])
    walked = f"of a straight window of {window.length_m:g} m that ends here, {window.noise_uT:g} uT of noise"
    named = {
        "gradient_ut_per_m": (norms.total, "norm of the gradient along the floor", "uT m-1"),
        "gradient_x_ut_per_m": (norms.x, "norm of the derivative with x", "uT m-1"),
        "gradient_y_ut_per_m": (norms.y, "norm of the derivative with y", "uT m-1"),
        "information_per_m2": (information, f"information of one reading of {window.noise_uT:g} uT noise", "m-2"),
        "expected_error_m": (error_m, f"least rms horizontal error {walked}, heading unknown, offset known", "m"),
    }
    return {name: _on_cells(grid, *about, "measured") for name, about in named.items()}


def _on_cells(grid: FieldGrid, values: NDArray[Any], long_name: str, units: str, linked: str) -> Variable:
    masked = np.where(grid.measured, values, np.float32(np.nan)).astype(np.float32, copy=False)
    return Variable(AXES, masked, {
        "long_name": long_name, "units": units, "ancillary_variables": linked, "coordinates": "z y x",
        "cell_methods": "z: y: x: point",
    })  # fmt: skip


def _axes(grid: FieldGrid) -> dict[str, Variable]:
    """Centres of the cells, and the edges of the cells in the plane."""
    _, ny, nx, _ = grid.mean_uT.shape
    half_m = grid.resolution_m / 2
    x_m, y_m = (first + grid.resolution_m * np.arange(n) for first, n in zip(grid.origin_m, (nx, ny), strict=True))
    axes = {
        "z": Variable(("z",), np.asarray(grid.heights_m, np.float64), {
            "units": "m", "axis": "Z", "positive": "up", "long_name": "height in the building's frame",
        })
    }  # fmt: skip
    for name, centres_m in (("y", y_m), ("x", x_m)):
        axes[name] = Variable((name,), centres_m, {
            "units": "m", "axis": name.upper(), "long_name": f"{name} of the building's plan", "bounds": f"{name}_bnds",
        })  # fmt: skip
        axes[f"{name}_bnds"] = Variable((name, "bnds"), np.stack([centres_m - half_m, centres_m + half_m], axis=1), {})
    return axes


def _about(grid: FieldGrid, map_id: str) -> dict[str, Any]:
    return {
        "Conventions": "CF-1.11",
        "title": "Map of the magnetic flux density on one floor of a building",
        "source": "Isodyn: Gaussian-process regression on magnetometer surveys walked through the building",
        "id": map_id,
        "comment": "Frame: the building's own plan; x and y in metres along its axes, z in metres upward. Values are "
                   "the posterior mean at cell centres, bilinear between them; standard deviations are of the field "
                   "itself, without sensor noise. Cells that no survey came close to are missing.",
        "components": " ".join(grid.component_names),
        "resolution_m": float(grid.resolution_m),
        "ambient_ut": np.asarray(grid.ambient_uT, np.float64),
        "prior_sd_ut": np.asarray(grid.prior_sd_uT, np.float64),
        "noise_sd_ut": np.asarray(grid.noise_sd_uT, np.float64),
        "error_correlation_m": float(grid.error_correlation_m),
    }  # fmt: skip
