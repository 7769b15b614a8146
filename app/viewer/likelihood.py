"""The likelihood of a window over a floor as a PNG picture: where it may be, the best match, and the runner-up."""

import io

import numpy as np

from app.positioning.explanation import Explanation

__all__ = ["likelihood_png"]

_DPI = 100
_LONG_SIDE_INCHES = 7.0
_LOWEST_NATS = -20.0


def likelihood_png(explanation: Explanation) -> bytes:
    """A PNG of the log-likelihood relative to the best place, cut off at twenty nats below it."""
    # Imported here because matplotlib costs half a second that only a picture should pay.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    surface = explanation.surface
    ny, nx = surface.log_likelihood.shape
    long_side = max(ny, nx)
    size = (max(nx / long_side, 0.35) * _LONG_SIDE_INCHES + 1.2, max(ny / long_side, 0.35) * _LONG_SIDE_INCHES)
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    half, (x0, y0) = surface.resolution_m / 2.0, surface.origin_m
    extent = (x0 - half, x0 + (nx - 0.5) * surface.resolution_m, y0 - half, y0 + (ny - 0.5) * surface.resolution_m)
    shown = np.clip(surface.log_likelihood, _LOWEST_NATS, 0.0)
    image = axes.imshow(shown, origin="lower", extent=extent, cmap="viridis", vmin=_LOWEST_NATS, vmax=0.0)
    figure.colorbar(image, ax=axes, label="log-likelihood less the best, nats", shrink=0.8)
    for place, marker, name in ((explanation.best, "o", "best match"), (explanation.runner_up, "s", "runner-up")):
        if place is not None and place.floor_id == surface.floor_id:
            axes.plot(*place.position_m[:2], marker, mfc="none", mec="#ff5a5f", ms=11, mew=1.8,
                      label=f"{name}, probability {place.probability:.2g}")  # fmt: skip
    axes.set_xlabel("x, m")
    axes.set_ylabel("y, m")
    axes.set_aspect("equal")
    axes.set_title("Where the window's last sample may be", fontsize=11)
    axes.legend(loc="upper right", fontsize=8, framealpha=0.85)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
