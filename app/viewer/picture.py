"""What a scene tells its page about the picture: in words and numbers, so that nothing is in colours alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import BaseModel

from app.viewer.floor_scene import ShownFloor
from app.viewer.layers import LAYERS, about_layer, layer_names
from app.viewer.legends import Legend

__all__ = [
    "FloorInWords", "Marked", "OfferedLayer", "Picked", "Picture", "SupportView", "floors_in_words",
    "offered_layers",
]  # fmt: skip


class OfferedLayer(BaseModel):
    name: str
    title: str
    unit: str
    about: str


class FloorInWords(BaseModel):
    """One floor: the layer's median and the range of 90 % of it, the area measured, how many walks."""

    floor_id: str
    name: str
    map_id: str | None
    median: float | None = None
    low: float | None = None
    high: float | None = None
    measured_m2: float = 0.0
    walks: int = 0


class Picture(BaseModel):
    """What is shown now. `notes`: what was asked for and is not shown, and why."""

    building_id: str | None
    floor_id: str | None
    map_id: str | None
    layer: str
    height_m: float | None
    heights_m: list[float]
    layers: list[OfferedLayer]
    legend: Legend | None
    walks_legend: Legend | None
    floors: list[FloorInWords]
    ground_m: float
    separation_m: float
    arrows: int
    walks: bool
    notes: list[str]


class Marked(BaseModel):
    """What was marked on the floors; the likelihood's colours when there is one."""

    likelihood_legend: Legend | None


class SupportView(BaseModel):
    survey_id: str
    name: str
    samples: int
    nearest_m: float
    residual_ut: list[float] | None


class Picked(BaseModel):
    """What is known at a place; null values where nothing was measured. `point_m` in building metres."""

    floor_id: str
    floor: str
    map_id: str
    point_m: list[float]
    measured: bool
    components: list[str]
    mean_ut: list[float] | None
    sd_ut: list[float] | None
    norm_ut: float | None
    layer: str
    layer_title: str
    layer_unit: str
    layer_value: float | None
    surveys: list[SupportView] | None = None


def offered_layers(shown: Sequence[ShownFloor], stored: Sequence[frozenset[str]]) -> list[OfferedLayer]:
    """The layers that every shown map has, in their usual order; `stored`: what each has beside its grid."""
    has = [set(layer_names(s.grid.components, more)) for s, more in zip(shown, stored, strict=True) if s.grid]
    names = [name for name in LAYERS if name != "measured" and all(name in each for each in has)]
    about = {name: about_layer(name) for name in (names if has else ["norm"])}
    return [OfferedLayer(name=n, title=a.title, unit=a.unit, about=a.about) for n, a in about.items()]


def floors_in_words(shown: Sequence[ShownFloor]) -> list[FloorInWords]:
    return [_in_words(floor) for floor in shown]


def _in_words(shown: ShownFloor) -> FloorInWords:
    told = FloorInWords(floor_id=shown.floor.id, name=shown.floor.name, map_id=shown.map_id, walks=len(shown.walks))
    if shown.grid is None or shown.values is None or not np.isfinite(shown.values).any():
        return told
    low, middle, high = (float(q) for q in np.nanpercentile(shown.values, [5.0, 50.0, 95.0]))
    area_m2 = float(shown.grid.measured[shown.height_index].sum()) * shown.grid.resolution_m**2
    return told.model_copy(update={"median": middle, "low": low, "high": high, "measured_m2": area_m2})
