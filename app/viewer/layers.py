"""Layers of a map as arrays and colours: one layer at one height, with its unit and a colour-blind-safe colour map."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.field.expected_error import WindowModel, expected_error_m, point_information
from app.field.grid import FieldGrid
from app.field.localizability import gradient_norms
from app.field.samples import COMPONENT_NAMES, Components
from app.geometry import Array

__all__ = [
    "LAYERS",
    "STORED_LAYERS",
    "ColourScale",
    "Layer",
    "StoredLayers",
    "about_layer",
    "check_layer",
    "colour_scale",
    "difference_uT",
    "layer_names",
    "layer_values",
    "nearest_height",
]

StoredLayers = Mapping[str, NDArray[np.floating]]  # (nz, ny, nx) by name, of one map
FARTHEST_M = 0.5  # from the height asked for to the one shown
USUAL = WindowModel()
NONE_STORED: StoredLayers = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Layer:
    """How a layer is named, in which unit it is, which of matplotlib's colour maps shows it, and how it is read."""

    title: str
    unit: str
    about: str
    colour_map: str = "viridis"
    short: str = ""  # where the title is too long


def _information_title(window: WindowModel) -> str:
    return f"Information of one reading of {window.noise_uT:g} µT noise"


def _expected_error_title(window: WindowModel) -> str:
    offset = ", unknown offset" if window.bias_sd_uT > 0.0 else ""
    heading = ", known heading" if window.heading_sd_rad == 0.0 else ""
    return f"Expected error of a {window.length_m:g} m window, {window.noise_uT:g} µT noise{offset}{heading} (rms)"


_COMPONENT = "One component of the mean field, in the building's own axes."
_ALONG = "The part of the gradient that is met when walking this way."

LAYERS: dict[str, Layer] = {
    "norm": Layer("Magnitude |B|", "µT", "Length of the mean field. Steel bends it: every bump is a landmark."),
    "bx": Layer("Component Bx (along the plan's x)", "µT", _COMPONENT),
    "by": Layer("Component By (along the plan's y)", "µT", _COMPONENT),
    "bz": Layer("Component Bz (up)", "µT", _COMPONENT),
    "horizontal": Layer("Horizontal magnitude", "µT", "What a compass needle feels, whichever way it faces."),
    "vertical": Layer("Vertical component (up)", "µT", "Needs no heading, so a phone knows it well."),
    "sd": Layer(
        "Uncertainty (1 sd, all components)", "µT",
        "How far the true field may be from the map's: small along the walks, large away from them.", "cividis"),
    "inclination": Layer(
        "Inclination (below the horizontal)", "°", "How steeply the field dips. Outdoors it is the same everywhere."),
    "gradient": Layer(
        "Gradient along the floor", "µT/m", "How fast the field changes underfoot. Flat places look alike; steep ones "
        "tell a step of a few centimetres."),
    "gradient_x": Layer("Gradient along x", "µT/m", _ALONG),
    "gradient_y": Layer("Gradient along y", "µT/m", _ALONG),
    "information": Layer(
        _information_title(USUAL), "1/m²", "What one reading tells about the position: change of the field over its "
        "uncertainty, squared.", short="Information"),
    "expected_error": Layer(
        _expected_error_title(USUAL), "m", "How well a window that ends here can be placed, by the Cramér-Rao bound.",
        "cividis", "Expected error, rms"),
    "coverage": Layer("Coverage (surveys within 1 m)", "", "How many surveys came near: one is no check of another.",
                      "cividis"),
    "conflict": Layer(
        "Conflict (errors of left-out surveys / their stated sd)", "",
        "About 1 where surveys agree as well as they say; above 2 something moved, or a walk is misplaced.", "magma"),
    "difference": Layer(
        "Difference to the other map (of the field vectors)", "µT", "What changed between two versions of the map.",
        "magma", "Difference"),
    "measured": Layer("Measured cells", "", "Where the map answers at all.", "cividis"),
}  # fmt: skip
STORED_LAYERS = ("coverage", "conflict", "difference")
"""Not of the grid alone: coverage and conflict are left by the fit (an older map has none), difference needs two maps.
"""


def layer_names(components: Components, stored: Collection[str] = ()) -> tuple[str, ...]:
    """The layers a map of these components has, with those `stored` beside its grid."""
    own = () if components == "norm" else COMPONENT_NAMES[components]
    dip = () if components == "norm" else ("inclination",)
    told = ("gradient", "gradient_x", "gradient_y", "information", "expected_error")
    return ("norm", *own, *dip, "sd", *told, *(name for name in STORED_LAYERS if name in stored), "measured")


def nearest_height(grid: FieldGrid, height_m: float | None) -> int:
    """The index of the map's height that is nearest to `height_m` (of two as near the lower; None: the lowest).

    Raises InvalidInput, naming the heights there are, when none is within `FARTHEST_M`.
    """
    if height_m is None:
        return 0
    away_m = np.abs(grid.heights_m - height_m)
    if away_m.min() > FARTHEST_M + 1e-9:
        heights = ", ".join(f"{z:.2f}" for z in grid.heights_m)
        reason = f"{height_m:g} m is farther than {FARTHEST_M:g} m from every height of this map: {heights} m"
        raise InvalidInput(reason, Fault("/query/height_m", reason))
    return int(np.argmin(away_m))


def check_layer(grid: FieldGrid, layer: str, stored: Collection[str] = ()) -> None:
    """Raises InvalidInput, naming the layers this map has, when it has not this one."""
    known = layer_names(grid.components, stored)
    if layer not in known:
        older = " (maps built again have it)" if layer in STORED_LAYERS else ""
        raise InvalidInput(
            f"this {grid.components} map has no layer {layer!r}{older}; ask for one of {', '.join(known)}"
        )


def about_layer(layer: str, window: WindowModel = USUAL) -> Layer:
    """The layer, named after the window and the sensor it is for."""
    titles = {"information": _information_title, "expected_error": _expected_error_title}
    return replace(LAYERS[layer], title=titles[layer](window)) if layer in titles else LAYERS[layer]


def layer_values(
    grid: FieldGrid,
    layer: str,
    height_index: int = 0,
    stored: StoredLayers = NONE_STORED,
    window: WindowModel = USUAL,
) -> Array:
    """One layer at one height: (ny, nx), NaN where nothing was measured ("measured" itself: 1 and 0, never NaN).

    norm is the magnitude of the mean field; sd the root of the summed variances of the components; gradient the
    Frobenius norm of the derivative with x and y; inclination the angle of the mean field below the horizontal,
    degrees; information and expected_error those of `window`, the latter NaN too where no window that ends there is
    mapped. Raises InvalidInput naming the layers, or heights, of this map.
    """
    check_layer(grid, layer, stored)
    if not 0 <= height_index < len(grid.heights_m):
        heights = ", ".join(f"{k}: {z:.2f} m" for k, z in enumerate(grid.heights_m))
        raise InvalidInput(f"this map has no height {height_index}; its heights are {heights}")
    measured = grid.measured[height_index]
    if layer == "measured":
        return np.asarray(measured.astype(np.float64))
    raw = stored[layer][height_index] if layer in STORED_LAYERS else _raw_values(grid, layer, height_index, window)
    return np.asarray(np.where(measured, raw, np.nan), dtype=np.float64)


def _raw_values(grid: FieldGrid, layer: str, k: int, window: WindowModel) -> Array:
    if layer == "norm":
        return np.asarray(np.linalg.norm(grid.mean_uT[k].astype(np.float64), axis=-1))
    if layer == "sd":
        return np.asarray(np.linalg.norm(grid.sd_uT[k].astype(np.float64), axis=-1))
    if layer == "inclination":
        return _inclination_deg(grid, k)
    if layer.startswith("gradient"):
        along = gradient_norms(grid.gradient_uT_per_m[k, ..., :2])  # a third column, where there is one, is with height
        return {"gradient": along.total, "gradient_x": along.x, "gradient_y": along.y}[layer]
    if layer == "information":
        return point_information(grid, k, window.noise_uT)
    if layer == "expected_error":
        return expected_error_m(grid, k, window)
    return np.asarray(grid.mean_uT[k, ..., grid.component_names.index(layer)].astype(np.float64))


def _inclination_deg(grid: FieldGrid, k: int) -> Array:
    mean = grid.mean_uT[k].astype(np.float64)
    horizontal = mean[..., 0] if grid.components == "level" else np.linalg.norm(mean[..., :2], axis=-1)
    return np.asarray(np.degrees(np.arctan2(-mean[..., -1], horizontal)))


def difference_uT(grid: FieldGrid, other: FieldGrid) -> NDArray[np.float32]:
    """(nz, ny, nx) length of the difference of two maps' mean fields at the cells of the first, uT.

    Maps of different components are compared by their magnitudes; NaN where either was not measured.
    """
    theirs, measured = _at_the_cells_of(grid, other)
    if grid.components == other.components:
        difference = np.linalg.norm(grid.mean_uT - theirs, axis=-1)
    else:
        difference = np.abs(np.linalg.norm(grid.mean_uT, axis=-1) - np.linalg.norm(theirs, axis=-1))
    return np.where(grid.measured & measured, difference, np.nan).astype(np.float32)


def _at_the_cells_of(grid: FieldGrid, other: FieldGrid) -> tuple[Array, NDArray[np.bool_]]:
    """The other map's mean (nz, ny, nx, c) and whether it was measured, at every cell of `grid`."""
    nz, ny, nx = grid.measured.shape
    x0_m, y0_m = grid.origin_m
    mean = np.zeros((nz, ny, nx, other.mean_uT.shape[-1]))
    measured = np.zeros((nz, ny, nx), dtype=np.bool_)
    x_m = x0_m + grid.resolution_m * np.arange(nx)
    for k, z_m in enumerate(grid.heights_m):
        for j in range(ny):  # a row at a time: interpolation holds some twenty copies of what it is asked
            there = other.at(np.column_stack([x_m, np.full(nx, y0_m + grid.resolution_m * j), np.full(nx, z_m)]))
            mean[k, j], measured[k, j] = there.mean_uT, there.measured
    return mean, measured


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Values from `low` to `high` spread over a colour map; what lies outside takes the end colours."""

    low: float
    high: float
    colour_map: str = "viridis"

    def rgb(self, values: Array) -> NDArray[np.uint8]:
        """sRGB colours (..., 3) of values (...). NaN takes the lowest colour: leave such cells out before."""
        from matplotlib import colormaps  # here, because half a second of import belongs to the first picture only

        unit = np.clip((np.nan_to_num(values, nan=self.low) - self.low) / (self.high - self.low), 0.0, 1.0)
        return np.asarray(colormaps[self.colour_map](unit, bytes=True))[..., :3]


def colour_scale(layer: str, values: Iterable[Array]) -> ColourScale:
    """One scale for several floors: the 1st to the 99th percentile of every value that is not NaN.

    That of conflict reaches from 0 to 2 at least: surveys that agree as well as they state must not look alarming.
    """
    seen = np.concatenate([np.zeros(0), *(v[np.isfinite(v)] for v in values)])
    if layer == "measured" or len(seen) == 0:
        return ColourScale(0.0, 1.0, LAYERS[layer].colour_map)
    low, high = (float(q) for q in np.percentile(seen, [1.0, 99.0]))
    if layer == "conflict":
        low, high = 0.0, max(2.0, high)
    if high - low < 1e-6 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    return ColourScale(low, high, LAYERS[layer].colour_map)
