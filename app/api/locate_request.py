"""What a client asks: a window, what is known about it, and how it is to be matched; and the same for the core."""

from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Discriminator, Field, Tag, model_validator

from app.api.models import Finite, Name, Point, RequestModel
from app.calibration.sensor_model import SensorModel
from app.errors import Fault, InvalidWindow
from app.geometry import Array, rotate_by_quaternion
from app.positioning.fix import LocateOptions
from app.positioning.window import Window
from app.survey.units import field_faults

__all__ = ["MAX_BATCH", "BatchBody", "LocateBody", "OrientationFrame", "Technique", "core_options", "core_window"]

MAX_BATCH = 100
MAX_SAMPLES = 20_000  # of the description; the setting max_window_samples refuses sooner

Microtesla = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]
Vector = Annotated[list[Microtesla], Field(min_length=3, max_length=3)]
Quaternion = Annotated[list[Annotated[Finite, Field(ge=-2, le=2)]], Field(min_length=4, max_length=4)]
Radians = Annotated[float, Field(allow_inf_nan=False, ge=-100.0, le=100.0)]
FloorId = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_-]+$")]

OrientationFrame = Literal["building", "level"]
Technique = Literal["ml", "mlr", "abl", "mad", "contour"]
STEP_SCALE_SD = 0.05
SPEED_SD = 0.2  # of a window indexed by time: nobody keeps a pace

_EXAMPLE: dict[str, Any] = {
    "window": {
        "frame": "level",
        "b_ut": [[19.8, 2.1, -43.0], [19.1, 2.6, -43.4], [18.2, 3.0, -44.1]],
        "displacement_m": [[0, 0, 0], [0.6, 0, 0], [1.2, 0, 0]],
        "t_s": [0.0, 0.5, 1.0],
        "noise_ut": 0.5,
    },
    "techniques": ["ml", "mlr", "abl"],
}


def _shape_of_field(value: object) -> str:
    first = value[0] if isinstance(value, list) and value else None
    return "magnitudes" if isinstance(first, (int, float)) else "vectors"


class WindowBody(RequestModel):
    """Samples in order of time. `displacement_m` is measured from the first sample."""

    frame: Annotated[
        Literal["building", "level", "body", "norm"],
        Field(description="building: b and displacement in the building frame; level: both in the level frame of the "
              "first sample, yaw unknown unless heading_rad is given; body: b in the sensor's axes with orientation, "
              "displacement in the frame that the orientation turns to; "
              "norm: b_ut is a flat list of |B|, displacement in the level frame"),
    ]  # fmt: skip
    b_ut: Annotated[
        Annotated[list[Vector], Tag("vectors"), Field(min_length=1, max_length=MAX_SAMPLES)]
        | Annotated[list[Microtesla], Tag("magnitudes"), Field(min_length=1, max_length=MAX_SAMPLES)],
        Discriminator(_shape_of_field),
    ]
    displacement_m: Annotated[
        list[Point] | None,
        Field(min_length=1, max_length=MAX_SAMPLES,
              description="from the first sample; leave it out for a window indexed by time, with t_s and speed_m_s"),
    ] = None  # fmt: skip
    t_s: Annotated[list[Finite], Field(max_length=MAX_SAMPLES)] | None = None
    speed_m_s: Annotated[
        Finite | None, Field(ge=0, le=100, description="of a window indexed by time: it went straight ahead, this fast")
    ] = None
    orientation: Annotated[
        list[Quaternion] | None, Field(max_length=MAX_SAMPLES, description="of frame body, [w, x, y, z]")
    ] = None
    orientation_frame: Annotated[
        OrientationFrame,
        Field(
            description="what orientation turns the sensor's axes to: building; level: the level frame of the first "
            "sample, whose yaw is unknown unless heading_rad is given (of a phone: its roll, pitch and gyroscope)"
        ),
    ] = "building"
    calibration_id: Annotated[
        FloorId | None, Field(description="of frame body: the device's calibration, applied to b_ut")
    ] = None
    device: Annotated[Name | None, Field(description="the same by name: its newest calibration")] = None
    heading_rad: Annotated[Radians | None, Field(description="yaw of the first sample's level frame")] = None
    heading_sd_rad: Annotated[Finite, Field(ge=1e-4, le=10)] | None = None
    yaw_rad: Annotated[
        Annotated[list[Radians], Field(max_length=MAX_SAMPLES)] | None,
        Field(description="yaw of the device at each sample from the first; default: it turns with the path"),
    ] = None
    noise_ut: Annotated[Finite, Field(gt=0, le=1000, description="sd of the sensor's noise, per axis")] = 0.5

    @model_validator(mode="after")
    def _lengths_agree(self) -> Self:
        n = len(self.b_ut)
        for name in ("displacement_m", "t_s", "orientation", "yaw_rad"):
            column = getattr(self, name)
            if column is not None and len(column) != n:
                raise ValueError(f"{name} has {len(column)} rows, b_ut has {n}; they must be equal")
        if isinstance(self.b_ut[0], list) == (self.frame == "norm"):
            shape = "a flat list of magnitudes" if self.frame == "norm" else "a list of [bx, by, bz]"
            raise ValueError(f"in the {self.frame} frame b_ut is {shape}")
        if self.heading_sd_rad is not None and self.heading_rad is None:
            raise ValueError("heading_sd_rad says how sure heading_rad is; send both or neither")
        if (self.displacement_m is None) == (self.speed_m_s is None):
            raise ValueError("send displacement_m, or t_s and speed_m_s for a window indexed by time")
        if self.speed_m_s is not None and self.t_s is None:
            raise ValueError("speed_m_s needs t_s")
        if self.speed_m_s is not None and self.frame in ("building", "body"):
            raise ValueError("a window indexed by time has no direction in the building: use frame level or norm")
        if self.frame == "body" and self.orientation is None:
            raise ValueError("the body frame needs orientation: [[w, x, y, z], ...], body to building")
        if self.frame != "body" and (self.calibration_id is not None or self.device is not None):
            raise ValueError(
                "a calibration is of the sensor's own axes: send frame body, b_ut uncorrected, orientation"
            )
        if self.frame != "body" and self.orientation_frame != "building":
            raise ValueError("orientation_frame is of frame body")
        return self


class PriorBody(RequestModel):
    position_m: Point
    sd_m: Annotated[Finite, Field(ge=1e-3, le=10_000)]


class Area(RequestModel):
    """A GeoJSON Polygon or MultiPolygon in building metres; further rings of a polygon are holes in it."""

    type: Literal["Polygon", "MultiPolygon"]
    coordinates: Annotated[list[Any], Field(min_length=1, max_length=1000)]

    @model_validator(mode="after")
    def _rings(self) -> Self:
        self.rings_m()
        return self

    def rings_m(self) -> list[Array]:
        """(k, 2) each."""
        polygons = [self.coordinates] if self.type == "Polygon" else self.coordinates
        try:
            rings = [np.asarray(ring, dtype=np.float64)[:, :2] for polygon in polygons for ring in polygon]
        except (TypeError, ValueError, IndexError, OverflowError) as error:
            raise ValueError(f"coordinates are not those of a {self.type}: lists of rings of [x, y]") from error
        if not rings or any(len(ring) < 4 or ring.shape[1] != 2 or not np.isfinite(ring).all() for ring in rings):
            raise ValueError("a ring needs at least four finite points [x, y], the last the first again")
        return rings


class OptionsBody(RequestModel):
    """Parameters of the techniques (Shockley 8.2, 8.3), and what is known of the window's errors."""

    mlr_ratio: Annotated[Finite, Field(ge=1, le=1e12)] = 10.0
    mlr_min_distance_m: Annotated[Finite, Field(gt=0, le=10_000)] = 5.0
    abl_threshold: Annotated[
        Finite | None, Field(ge=0, le=1e9, description="least peak of the likelihood, as a multiple of the uniform one")
    ] = None
    abl_min_probability: Annotated[Finite, Field(ge=0, le=1, description="that the heaviest bin must hold")] = 0.7
    abl_bin_m: Annotated[Finite, Field(gt=0, le=1000)] = 2.0
    gate_probability: Annotated[
        Finite, Field(gt=0, lt=1, description="of the chi-square gate: a right match fails it once in 1 / (1 - this)")
    ] = 0.997
    feature_rms_ut: Annotated[
        Finite | None,
        Field(gt=0, le=1000, description="a feature that fits worse everywhere is unknown; null: the gate"),
    ] = None
    bias_sd_ut: Annotated[
        Finite,
        Field(ge=0, le=1000, description="what is not known of the sensor's constant offset, per axis: integrated out. "
              "A phone that was never calibrated: 10, or composition demeaned"),
    ] = 0.5  # fmt: skip
    step_scale_sd: Annotated[
        Finite | None,
        Field(ge=0, le=0.5, description="relative sd of the displacements' scale; null: 0.05, by time 0.2"),
    ] = None
    heading_drift_sd_rad_per_m: Annotated[Finite, Field(ge=0, le=0.1, description="beyond yaw_rad")] = 0.003
    walkable: Annotated[Area | None, Field(description="where the device may be now, on every floor searched")] = None
    time_budget_ms: Annotated[
        Finite | None,
        Field(
            ge=1,
            le=600_000,
            description="when it ends, the best so far and what may have been missed; null: to the end",
        ),
    ] = None


class LocateBody(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [_EXAMPLE]})
    window: WindowBody
    composition: Literal["raw", "demeaned", "differenced", "feature"] = "raw"
    techniques: Annotated[
        list[Technique], Field(min_length=1, max_length=5, default_factory=lambda: ["ml", "mlr", "abl"])
    ]
    floor_ids: Annotated[list[FloorId], Field(min_length=1, max_length=1000)] | None = None
    prior: PriorBody | None = None
    options: OptionsBody = OptionsBody()


class BatchBody(RequestModel):
    queries: Annotated[list[LocateBody], Field(min_length=1, max_length=MAX_BATCH)]


def core_window(body: WindowBody, calibration: SensorModel | None = None) -> Window:
    """The window in one of the core's frames: a body window is calibrated, and turned to one of them, here."""
    B = np.asarray(body.b_ut, dtype=np.float64).reshape(len(body.b_ut), -1)
    if calibration is not None:
        B = calibration.apply(B)
    frame = body.frame
    norm_uT = B[:, 0] if frame == "norm" else np.linalg.norm(B, axis=1)
    message, faults = field_faults(norm_uT, lambda sample: f"/body/window/b_ut/{sample}")
    if message is not None:
        raise InvalidWindow(message, *faults)
    t_s = None if body.t_s is None else np.asarray(body.t_s)
    if t_s is not None and (backwards := np.flatnonzero(np.diff(t_s) <= 0.0)).size:
        at = int(backwards[0]) + 1
        reason = f"{t_s[at]:g} s does not come after {t_s[at - 1]:g} s"
        raise InvalidWindow("the window's time does not increase", Fault(f"/body/window/t_s/{at}", reason))
    device_to_frame = None
    if frame == "body":
        q = np.asarray(body.orientation, dtype=np.float64)
        norms = np.linalg.norm(q, axis=1)
        if (np.abs(norms - 1.0) > 0.1).any():
            bad = int(np.argmax(np.abs(norms - 1.0) > 0.1))
            raise InvalidWindow(
                "an orientation is not a unit quaternion",
                Fault(f"/body/window/orientation/{bad}", f"its norm is {norms[bad]:.3g}, not 1"),
            )
        q = q / norms[:, None]
        axes = np.repeat(np.eye(3)[None], len(q), axis=0)
        device_to_frame = np.stack([rotate_by_quaternion(q, axes[:, k]) for k in range(3)], axis=2)
        B, frame = rotate_by_quaternion(q, B), body.orientation_frame
    return Window(
        frame=frame,
        B_uT=B,
        displacement_m=_displacement_m(body, t_s),
        device_to_frame=device_to_frame,
        noise_uT=body.noise_ut,
        t_s=t_s,
        heading_rad=body.heading_rad,
        heading_sd_rad=body.heading_sd_rad,
        yaw_rad=None if body.yaw_rad is None else np.asarray(body.yaw_rad),
    )


def _displacement_m(body: WindowBody, t_s: Array | None) -> Array:
    """Told, or straight ahead at the told speed."""
    if body.displacement_m is not None:
        return np.asarray(body.displacement_m, dtype=np.float64)
    assert t_s is not None
    assert body.speed_m_s is not None
    ahead = body.speed_m_s * (t_s - t_s[0])
    return np.column_stack([ahead, np.zeros((len(ahead), 2))])


def core_options(body: LocateBody, clock: Callable[[], float]) -> LocateOptions:
    """The options of the core; a time budget runs from now."""
    asked = body.options
    scale_sd = asked.step_scale_sd
    if scale_sd is None:
        scale_sd = STEP_SCALE_SD if body.window.speed_m_s is None else SPEED_SD
    deadline = None if asked.time_budget_ms is None else clock() + 1e-3 * asked.time_budget_ms
    return LocateOptions(
        mlr_ratio=asked.mlr_ratio,
        mlr_min_distance_m=asked.mlr_min_distance_m,
        abl_threshold=asked.abl_threshold,
        abl_min_probability=asked.abl_min_probability,
        abl_bin_m=asked.abl_bin_m,
        gate_probability=asked.gate_probability,
        feature_rms_uT=asked.feature_rms_ut,
        bias_sd_uT=asked.bias_sd_ut,
        step_scale_sd=scale_sd,
        heading_drift_sd_rad_per_m=asked.heading_drift_sd_rad_per_m,
        walkable=None if asked.walkable is None else partial(_inside, asked.walkable.rings_m()),
        out_of_time=None if deadline is None else lambda: clock() > deadline,
    )


def _inside(rings_m: list[Array], _floor_id: str, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
    """(ny, nx) which points lie inside an odd number of rings."""
    from matplotlib.path import Path  # costs a tenth of a second, which only those who ask should pay

    x, y = np.meshgrid(x_m, y_m)
    points = np.column_stack([x.ravel(), y.ravel()])
    inside = np.zeros(len(points), dtype=np.bool_)
    for ring in rings_m:
        inside ^= Path(ring).contains_points(points)
    return inside.reshape(x.shape)
