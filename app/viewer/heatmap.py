"""A layer of a map as a PNG picture with axes in metres, a scale bar and a colour bar with its unit, for reports."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from app.field.expected_error import WindowModel
from app.field.grid import FieldGrid
from app.geometry import Array
from app.viewer.layers import (
    NONE_STORED,
    USUAL,
    ColourScale,
    Layer,
    StoredLayers,
    about_layer,
    colour_scale,
    layer_values,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

__all__ = ["heatmap_png"]

_DPI = 110
_LONG_SIDE_INCHES = 8.0
_NARROW = 0.4  # width over height: a bar that is a share of the map's own width would be a hair
_UNKNOWN_GREY = "#d0d0d0"


def heatmap_png(
    grid: FieldGrid,
    layer: str = "norm",
    title: str | None = None,
    height_index: int = 0,
    stored: StoredLayers = NONE_STORED,
    window: WindowModel = USUAL,
) -> bytes:
    """A PNG of one layer at one height. Unmeasured cells are blank, measured cells of which the layer knows nothing
    are grey; the same grid, layer, title and window give the same bytes.

    `window`: what the layers expected_error and information are for.

    Raises InvalidInput, naming the layers this map has, for a layer it does not have.
    """
    # Imported here because matplotlib costs half a second that only a picture should pay. Figures are used directly,
    # without pyplot, whose global state is not safe in a server's threads.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = layer_values(grid, layer, height_index, stored, window)
    about = about_layer(layer, window)
    figure = Figure(figsize=_size_inches(values.shape), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    scale = colour_scale(layer, [values])
    image = _draw_cells(axes, grid, values, scale, height_index)
    name = about.unit if title is None else _named(about)  # the picture's own title names the layer already
    _draw_colour_bar(figure, axes, image, layer, name, values, scale)
    _draw_scale_bar(figure, axes)
    text = title or f"{about.title}, z\u00a0=\u00a0{grid.heights_m[height_index]:.2f}\u00a0m"
    unknown = bool(np.any(grid.measured[height_index] & np.isnan(values)))
    axes.set_title(text + ("\n(grey: measured, but too little to tell)" if unknown else ""), fontsize=11, wrap=True)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _draw_cells(axes: Axes, grid: FieldGrid, values: Array, scale: ColourScale, height_index: int) -> AxesImage:
    from matplotlib.colors import ListedColormap
    from matplotlib.ticker import MaxNLocator

    x0, y0, _, x1, y1, _ = grid.bounds_m
    half = grid.resolution_m / 2
    extent = (x0 - half, x1 + half, y0 - half, y1 + half)
    unknown = np.ma.masked_equal(grid.measured[height_index] & np.isnan(values), False)
    axes.imshow(unknown, origin="lower", extent=extent, cmap=ListedColormap([_UNKNOWN_GREY]), interpolation="nearest")
    image = axes.imshow(
        np.ma.masked_invalid(values),
        origin="lower",
        extent=extent,
        cmap=scale.colour_map,
        vmin=scale.low,
        vmax=scale.high,
        interpolation="nearest",
    )
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_facecolor("white")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10]))
    for axis, first_m, last_m in ((axes.xaxis, x0, x1), (axes.yaxis, y0, y1)):
        if last_m - first_m < 0.15 * max(x1 - x0, y1 - y0):  # no room for two numbers
            axis.set_ticks([round((first_m + last_m) / 2)])
    return image


def _draw_colour_bar(
    figure: Figure, axes: Axes, image: AxesImage, layer: str, label: str, values: Array, scale: ColourScale
) -> None:
    """A bar as tall as the map beside it, in steps where the layer has only whole values."""
    from matplotlib.ticker import MaxNLocator

    shape = float(np.ptp(axes.get_xlim()) / np.ptp(axes.get_ylim()))
    beside = axes.inset_axes((1.03, 0.0, 0.035, 1.0)) if shape >= _NARROW else None
    place: dict[str, Any] = {"ax": axes, "shrink": 0.85} if beside is None else {"cax": beside}
    if layer == "measured":
        bar = figure.colorbar(image, boundaries=[-0.5, 0.5, 1.5], **place)
        bar.set_ticks([0.0, 1.0], labels=["not\nmeasured", "measured"])
        return
    counted = np.arange(np.floor(scale.low), np.ceil(scale.high) + 1.0)
    steps: dict[str, Any] = {"boundaries": np.append(counted - 0.5, counted[-1] + 0.5)} if layer == "coverage" else {}
    bar = figure.colorbar(image, extend="neither" if steps else _beyond(values, scale), **steps, **place)
    bar.set_label(label)
    if steps:
        bar.locator = MaxNLocator(8, integer=True)
        bar.update_ticks()


def _named(about: Layer) -> str:
    name = about.short or about.title
    return f"{name} ({about.unit})" if about.unit else name


def _draw_scale_bar(figure: Figure, axes: Axes) -> None:
    """A bar of a round length, about a fifth of the floor's longer side, under the picture, where it hides nothing."""
    from matplotlib.transforms import ScaledTranslation
    from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar

    sides_m = (np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim()))
    length_m = _round_length_m(float(max(sides_m)) / 5.0)
    below = axes.transAxes + ScaledTranslation(0.0, -0.45, figure.dpi_scale_trans)
    bar = AnchoredSizeBar(
        axes.transData, length_m, f"{length_m:g} m", "upper center", pad=0.1, sep=3, frameon=False,
        bbox_to_anchor=(0.5, 0.0), bbox_transform=below,
    )  # fmt: skip
    bar.size_bar.get_children()[0].set_linewidth(2.5)
    axes.add_artist(bar)


def _beyond(values: Array, scale: ColourScale) -> Literal["neither", "min", "max", "both"]:
    """At which ends of the scale there are values outside it."""
    below, above = bool(np.any(values < scale.low)), bool(np.any(values > scale.high))
    if below and above:
        return "both"
    return "min" if below else "max" if above else "neither"


def _round_length_m(about_m: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten that is not above `about_m`."""
    power = 10.0 ** np.floor(np.log10(about_m))
    return float(max(step * power for step in (1.0, 2.0, 5.0) if step * power <= about_m * (1.0 + 1e-9)))


def _size_inches(shape: tuple[int, ...]) -> tuple[float, float]:
    """The picture takes the shape of the floor, within reason, with room for the colour bar."""
    ny, nx = shape
    aspect = float(np.clip(ny / nx, 0.25, 2.0))
    if aspect <= 1.0:
        return _LONG_SIDE_INCHES, max(_LONG_SIDE_INCHES * aspect * 0.81 + 1.1, 2.8)
    return _LONG_SIDE_INCHES / aspect + 1.6, _LONG_SIDE_INCHES + 0.3
