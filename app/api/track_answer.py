"""What a client is told of a track: itself, its estimate, its path."""

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from app.api.locate_request import OrientationFrame
from app.api.models import AppliedView
from app.api.track_request import Frame
from app.db.tables import Track
from app.services.follow import Outcome
from app.services.track_estimate import PATH_NAMES

__all__ = [
    "EstimateView", "PathView", "ReplayedEnd", "StepsAnswer", "StepsPage", "TrackDetail", "TrackView",
    "path_points", "show_track", "smoothed_points", "steps_answer",
]  # fmt: skip

State = Literal["searching", "converged", "lost"]
Matrix = list[list[float]]

_FLOOR_ID = "01a2014f-5d0e-7a53-8f2c-6f2f3d1a9b10"
_EXAMPLE: dict[str, Any] = {
    "state": "converged", "reason": None, "step": 412, "t_s": 41.2, "probability": 0.9999,
    "floor_id": _FLOOR_ID, "position_m": [12.31, 4.52, 1.2], "covariance_m2": [[0.031, 0.002], [0.002, 0.024]],
    "heading_rad": 1.57, "heading_sd_rad": 0.03, "radius_68_m": 0.25, "radius_95_m": 0.42,
    "floor_probability": {_FLOOR_ID: 1.0},
    "modes": [{"floor_id": _FLOOR_ID, "position_m": [12.31, 4.52, 1.2], "heading_rad": 1.57, "probability": 1.0}],
    "measured": 1.0, "step_scale": 0.98, "particles": 2000, "effective_sample_size": 1630.2,
}  # fmt: skip


class ModeView(BaseModel):
    floor_id: str
    position_m: list[float]
    heading_rad: float
    probability: float


class AttitudeView(BaseModel):
    """How the device is turned; angles are yaw, pitch, roll of 3-2-1, z up, with their sds."""

    frame: Annotated[Literal["building", "relative"], Field(description="relative: the level frame of the first step")]
    orientation: Annotated[list[float], Field(description="the sensor's axes to the frame, [w, x, y, z]")]
    yaw_rad: float
    pitch_rad: float
    roll_rad: float
    yaw_sd_rad: Annotated[float, Field(description="1.8 where nothing is known of it yet")]
    pitch_sd_rad: float
    roll_sd_rad: float
    disturbed: Annotated[bool | None, Field(description="the last magnetometer reading did not fit; null: none came")]


class EstimateView(BaseModel):
    """The belief after a step. Places are null while nothing was found."""

    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE]})
    state: Annotated[State, Field(description="lost: it was converged, and the readings no longer fit")]
    reason: Annotated[str | None, Field(description="for every state but converged: why, and what would help")]
    step: Annotated[int | None, Field(description="number of the last step that was followed")]
    t_s: float | None
    probability: Annotated[float, Field(description="that the track follows the device")]
    floor_id: str | None
    position_m: Annotated[list[float] | None, Field(description="of the strongest mode")]
    covariance_m2: Annotated[
        Matrix | None, Field(description="of the belief on this floor about the position, x and y")
    ]
    heading_rad: Annotated[float | None, Field(description="yaw of the track's frame in the building")]
    heading_sd_rad: float | None
    radius_68_m: float | None
    radius_95_m: float | None
    floor_probability: dict[str, float] | None
    modes: list[ModeView]
    measured: Annotated[float | None, Field(description="how much of the last metres is mapped, 0 to 1")]
    step_scale: Annotated[float | None, Field(description="true length of displacements over what was told")]
    particles: int | None
    effective_sample_size: float | None
    disturbed: Annotated[
        bool, Field(description="the last readings fit no place of the belief: something magnetic is near, and they "
                    "count for little")
    ] = False  # fmt: skip
    attitude: Annotated[AttitudeView | None, Field(description="of the device, where steps bring inertial samples")] = (
        None
    )


class TrackView(BaseModel):
    """A track. `spec` of it never changes: maps, options, prior and ground are pinned when it is made."""

    id: str
    building_id: str
    name: str | None
    status: Literal["active", "ended"]
    ended_reason: Annotated[Literal["idle", "asked"] | None, Field(description="idle: no step came for too long")]
    frame: Frame
    seed: int
    floor_ids: list[str]
    map_ids: Annotated[list[str], Field(description="the maps it is followed on, whatever is built later")]
    options: Annotated[dict[str, Any], Field(description="of the filter, all with their values")]
    prior: dict[str, Any] | None
    orientation_frame: Annotated[OrientationFrame, Field(description="of frame body")]
    calibration: Annotated[AppliedView | None, Field(description="applied to every step; null: none")]
    attitude: Annotated[dict[str, Any] | None, Field(description="the reference of its own attitude; null: none")]
    next_step: Annotated[int, Field(description="the number waited for; all before it are stored, or were given up")]
    waiting: Annotated[int, Field(description="steps that came before one that is missing")]
    idle_timeout_s: float
    created_at: datetime
    last_step_at: datetime
    ended_at: datetime | None
    links: dict[str, str]


class TrackDetail(TrackView):
    estimate: EstimateView


class StepsAnswer(BaseModel):
    """What became of the steps of a request, all of which is stored."""

    track_id: str
    status: Literal["active"] = "active"
    next_step: Annotated[int, Field(description="the number waited for")]
    accepted: Annotated[int, Field(description="new steps: followed, or waiting")]
    duplicates: Annotated[int, Field(description="sent before; they changed nothing")]
    late: Annotated[int, Field(description="dropped: they came after their gap was given up")]
    waiting: Annotated[int, Field(description="steps that wait for one that is missing")]
    estimate: EstimateView


class PathPoint(BaseModel):
    """Where the device was at a step. `settled` and no state: of a smoothed path."""

    step: int
    t_s: float
    state: State | None = None
    settled: bool | None = None
    floor_id: str | None = None
    position_m: list[float] | None = None
    covariance_m2: Matrix | None = None
    heading_rad: float | None = None
    radius_68_m: float | None = None
    radius_95_m: float | None = None
    probability: float | None = None


class PathView(BaseModel):
    track_id: str
    smoothed: bool
    points: list[PathPoint]
    links: dict[str, str]


class StepsPage(BaseModel):
    """Steps as they were sent and followed, in order."""

    track_id: str
    steps: list[dict[str, Any]]
    links: dict[str, str]


class ReplayedEnd(BaseModel):
    """The last line. `sha256` is that of all that was said, as it comes to now."""

    kind: Literal["end"] = "end"
    equal: bool
    batches: int
    different: int
    sha256: str | None
    version: Annotated[str, Field(description="of the program that followed it now")]


def show_track(row: Track, idle: bool, idle_timeout_s: float) -> TrackView:
    """`idle`: no step came for too long, whether or not that was written down yet."""
    ended = row.status == "ended" or idle
    path = f"/v1/tracks/{row.id}"
    return TrackView(
        id=row.id, building_id=row.building_id, name=row.name, status="ended" if ended else "active",
        ended_reason=(row.ended_reason or "idle") if ended else None,  # type: ignore[arg-type]
        frame=row.frame, seed=row.seed, floor_ids=[each[0] for each in row.spec["maps"]],  # type: ignore[arg-type]
        map_ids=[each[1] for each in row.spec["maps"]],
        options={name.replace("_uT", "_ut"): value for name, value in row.spec["options"].items()},
        prior=row.spec["prior"], orientation_frame=row.spec.get("orientation_frame", "building"),
        calibration=_calibration(row), attitude=row.spec.get("attitude"),
        next_step=row.next_step, waiting=len(row.waiting), idle_timeout_s=idle_timeout_s,
        created_at=row.created_at, last_step_at=row.touched_at, ended_at=row.ended_at,
        links={
            "self": path, "steps": f"{path}/steps", "stream": f"{path}/stream", "path": f"{path}/path",
            "replay": f"{path}/replay",
        },
    )  # fmt: skip


def _calibration(row: Track) -> AppliedView | None:
    told = row.spec.get("calibration")
    return None if told is None else AppliedView(**{name: told[name] for name in ("id", "device", "version")})


def steps_answer(outcome: Outcome) -> dict[str, Any]:
    """A StepsAnswer as plain values: made of checked parts, it goes out without being checked again."""
    return {
        "track_id": outcome.track_id, "status": "active", "next_step": outcome.next_step,
        "accepted": outcome.accepted, "duplicates": outcome.duplicates, "late": outcome.late,
        "waiting": outcome.waiting, "estimate": outcome.estimate,
    }  # fmt: skip


def path_points(rows: Sequence[Sequence[Any]], floor_ids: Sequence[str]) -> list[PathPoint]:
    """Points of a path's rows."""
    return [_point(dict(zip(PATH_NAMES, row, strict=False)), floor_ids) for row in rows]


def _point(told: Mapping[str, Any], floor_ids: Sequence[str]) -> PathPoint:
    if "floor_id" not in told:
        return PathPoint(step=told["step"], t_s=told["t_s"], state=told["state"])
    return PathPoint(
        step=told["step"], t_s=told["t_s"], state=told["state"], floor_id=floor_ids[told["floor_id"]],
        position_m=[told["x_m"], told["y_m"], told["z_m"]],
        covariance_m2=[[told["xx_m2"], told["xy_m2"]], [told["yx_m2"], told["yy_m2"]]],
        heading_rad=told["heading_rad"], radius_68_m=told["radius_68_m"], radius_95_m=told["radius_95_m"],
        probability=told["probability"],
    )  # fmt: skip


def smoothed_points(
    settled: Sequence[Sequence[Any]], open_rows: Sequence[Sequence[Any]], floor_ids: Sequence[str]
) -> list[PathPoint]:
    """Points of smoothed places, in order of their steps; what was said last of a step holds."""
    last = {row[0]: (row, True) for row in settled} | {row[0]: (row, False) for row in open_rows}
    return [
        PathPoint(step=row[0], t_s=row[1], settled=done, floor_id=floor_ids[row[2]], position_m=list(row[3:6]),
                  covariance_m2=[list(row[6:8]), list(row[8:10])])
        for row, done in (last[number] for number in sorted(last))
    ]  # fmt: skip
