"""A layer of a map as a PNG picture with axes in metres and a colour bar with its unit, for reports."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from app.field.grid import FieldGrid
from app.viewer.layers import LAYERS, colour_scale, layer_values

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["heatmap_png"]

_DPI = 110
_LONG_SIDE_INCHES = 8.0


def heatmap_png(grid: FieldGrid, layer: str = "norm", title: str | None = None, height_index: int = 0) -> bytes:
    """A PNG of one layer at one height. Unmeasured cells are blank; the same grid and title give the same bytes.

    Raises InvalidInput, naming the layers this map has, for a layer it does not have.
    """
    # Imported here because matplotlib costs half a second that only a picture should pay. Figures are used directly,
    # without pyplot, whose global state is not safe in a server's threads.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = layer_values(grid, layer, height_index)
    figure = Figure(figsize=_size_inches(values.shape), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    _draw(figure, axes, grid, layer, height_index)
    axes.set_title(title or f"{LAYERS[layer].title} at {grid.heights_m[height_index]:.2f} m", fontsize=11)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def _draw(figure: Figure, axes: Axes, grid: FieldGrid, layer: str, height_index: int) -> None:
    from matplotlib import colormaps

    values = layer_values(grid, layer, height_index)
    scale = colour_scale(layer, [values])
    x0, y0, _, x1, y1, _ = grid.bounds_m
    half = grid.resolution_m / 2
    image = axes.imshow(
        np.ma.masked_invalid(values),
        origin="lower",
        extent=(x0 - half, x1 + half, y0 - half, y1 + half),
        cmap=colormaps[scale.colour_map].resampled(2 if layer == "measured" else 256),
        vmin=scale.low,
        vmax=scale.high,
        interpolation="nearest",
    )
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.set_facecolor("white")
    bar = figure.colorbar(image, ax=axes, shrink=0.85, extend="neither" if layer == "measured" else "both")
    if layer == "measured":
        bar.set_ticks([0.25, 0.75], labels=["not measured", "measured"])
    else:
        bar.set_label(f"{LAYERS[layer].title} ({LAYERS[layer].unit})")


def _size_inches(shape: tuple[int, ...]) -> tuple[float, float]:
    """The picture takes the shape of the floor, within reason, with room for the colour bar."""
    ny, nx = shape
    aspect = float(np.clip(ny / nx, 0.35, 2.0))
    if aspect <= 1.0:
        return _LONG_SIDE_INCHES, _LONG_SIDE_INCHES * aspect * 0.85 + 0.9
    return _LONG_SIDE_INCHES / aspect + 1.6, _LONG_SIDE_INCHES
