"""What a demonstration shows the server (floors, surveys, windows to ask), and the truth it keeps to itself."""

import gzip
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from app.geometry import Array
from app.positioning.window import Window

__all__ = ["DemoFloor", "Question", "SurveyFile", "Told", "World", "body_of"]

Told = Callable[[int, int], None]  # (done, total)


@dataclass(frozen=True, slots=True)
class SurveyFile:
    """A survey as it is uploaded: gzip-compressed bytes."""

    name: str
    format: str
    gzipped: bytes

    @classmethod
    def of(cls, name: str, format: str, data: bytes) -> "SurveyFile":
        return cls(name, format, gzip.compress(data, compresslevel=3))


@dataclass(frozen=True, slots=True)
class DemoFloor:
    """One floor: the body that makes it, and its surveys."""

    name: str
    body: dict[str, Any]
    surveys: list[SurveyFile]


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """A window of an unseen walk: the body that asks, and the answer the server is not told.

    floor          index of the true floor; `truth_m` (3,) where the device was at the last sample
    path_m         (n, 2) the stretch truly walked
    covered        whether other walks mapped at least 80 % of it (within 1.5 m)
    """

    walk: str
    length_m: float
    body: dict[str, Any]
    floor: int
    truth_m: Array
    path_m: Array
    covered: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """All a demonstration needs. `field_uT`, points (n, 3) to uT (n, 3), is there when the true field is known."""

    building: str
    floors: list[DemoFloor]
    questions: list[Question]
    notes: list[str] = field(default_factory=list)
    field_uT: Callable[[Array], Array] | None = None
    probes_m: list[Array] = field(default_factory=list)  # per floor, where the map is compared with the true field


def body_of(window: Window) -> dict[str, Any]:
    """The JSON of a window."""
    B = window.B_uT[:, 0] if window.frame == "norm" else window.B_uT
    columns = {"t_s": window.t_s, "yaw_rad": window.yaw_rad}
    return {
        "frame": window.frame,
        "b_ut": np.round(B, 4).tolist(),
        "displacement_m": np.round(window.displacement_m, 4).tolist(),
        "noise_ut": window.noise_uT,
        "heading_rad": window.heading_rad,
        "heading_sd_rad": window.heading_sd_rad,
        **{name: None if column is None else np.round(column, 5).tolist() for name, column in columns.items()},
    }
