"""What is read of files from outside, in this process or another: a survey on its floor, a picture drawn anew."""

from dataclasses import dataclass, replace

import numpy as np

from app.calibration.sensor_model import SensorModel
from app.field.samples import SampleFrame
from app.services.receive_plan import Picture, redraw
from app.survey.read import read_survey
from app.survey.walk import Walk

__all__ = ["Order", "PictureOrder", "SurveyOrder", "carry_out", "read_on_floor"]

DEVICE_HEIGHT_FORMATS = frozenset({"indoor-location-2020"})  # their z is height above the slab, not building z


@dataclass(frozen=True, slots=True, eq=False)
class SurveyOrder:
    """A survey file, as `app.survey.read.read_survey` takes it, of a floor whose slab is at `elevation_m`."""

    data: bytes
    format: str
    frame: SampleFrame
    elevation_m: float
    session: str | None = None
    correct: SensorModel | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PictureOrder:
    """A picture of a floor, as `app.services.receive_plan.redraw` takes it."""

    data: bytes


Order = SurveyOrder | PictureOrder


def read_on_floor(order: SurveyOrder) -> Walk:
    """The walk in a survey file, in building metres. Raises UnreadableSurvey, TooLarge."""
    correct = None if order.correct is None else order.correct.apply
    walk = read_survey(order.data, format=order.format, frame=order.frame, session=order.session, correct=correct)
    if order.format not in DEVICE_HEIGHT_FORMATS:
        return walk
    lifted_m = walk.samples.p_building_m + np.array([0.0, 0.0, order.elevation_m])
    return replace(walk, samples=replace(walk.samples, p_building_m=lifted_m))


def carry_out(order: Order) -> Walk | Picture:
    """Raises InvalidInput, TooLarge."""
    return redraw(order.data) if isinstance(order, PictureOrder) else read_on_floor(order)
