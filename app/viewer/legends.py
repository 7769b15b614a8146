"""Legends as values: what colours mean, for a page to draw and for a reader who does not see them."""

import numpy as np
from pydantic import BaseModel

from app.viewer.layers import ColourScale

__all__ = ["Legend", "legend"]

_COLOURS = 16
_TICKS = 5


class Legend(BaseModel):
    """A colour bar: `colours` (CSS) evenly from low to high, `ticks` their values in words."""

    title: str
    unit: str
    low: float
    high: float
    colours: list[str]
    ticks: list[str]


def legend(title: str, unit: str, scale: ColourScale) -> Legend:
    """A legend that can be read without seeing colours."""
    rgb = scale.rgb(np.linspace(scale.low, scale.high, _COLOURS))
    decimals = int(np.clip(2 - np.floor(np.log10(scale.high - scale.low)), 0, 3))
    ticks = [f"{value:.{decimals}f}" for value in np.linspace(scale.low, scale.high, _TICKS)]
    colours = [f"rgb({r},{g},{b})" for r, g, b in rgb.tolist()]
    return Legend(title=title, unit=unit, low=scale.low, high=scale.high, colours=colours, ticks=ticks)
