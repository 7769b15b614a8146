"""The two journeys of the service, over HTTP alone: surveys become maps, windows become positions."""

import io
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from app.cli.demo.connection import Connection
from app.cli.demo.server import DemoError
from app.cli.demo.world import DemoFloor, Question, Told, World
from app.geometry import Array

__all__ = ["Answer", "MappedFloor", "ask", "make_building", "mapped_floors", "upload", "wait_for_job"]

POLL_S = 0.3
TRACK_SAMPLES = 800
FINAL = ("successful", "failed", "dismissed")


@dataclass(frozen=True, slots=True, eq=False)
class MappedFloor:
    """A floor with its active map, as the server tells it.

    index        of the floor in the world
    layers       of the map's export: x_m, y_m, measured and one array per component and its sd, NaN where unmeasured
    tracks_m     one (n, 2) path per survey
    error_uT, error_sd_uT    (m, 3) map less true field at the probes it answers and the sd it states, where the true
                 field is known; else None
    """

    name: str
    index: int
    floor_id: str
    map: dict[str, Any]
    quality: dict[str, Any]
    layers: dict[str, Array]
    tracks_m: list[Array] = field(default_factory=list)
    error_uT: Array | None = None
    error_sd_uT: Array | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """A question, the fix it got, and the time from request to answer."""

    question: Question
    fix: dict[str, Any]
    http_ms: float


def make_building(api: Connection, world: World) -> tuple[str, list[str]]:
    """Make the building and its floors: their ids."""
    building_id = str(api.call("POST", "/v1/buildings", json={"name": world.building}).json()["id"])
    path = f"/v1/buildings/{building_id}/floors"
    return building_id, [str(api.call("POST", path, json=floor.body).json()["id"]) for floor in world.floors]


def upload(api: Connection, floor_id: str, floor: DemoFloor, told: Callable[[], None]) -> str:
    """Upload a floor's surveys; the id of the job that maps the last of them, and so all."""
    job_id = ""
    for survey in floor.surveys:
        answer = api.call(
            "POST",
            f"/v1/floors/{floor_id}/surveys",
            params={"format": survey.format, "name": survey.name},
            headers={"Content-Encoding": "gzip", "Content-Type": "application/octet-stream"},
            content=survey.gzipped,
        ).json()
        job_id = str(answer["job"]["id"])
        told()
    return job_id


def wait_for_job(api: Connection, job_id: str, told: Callable[[int, str], None]) -> dict[str, Any]:
    """Poll a job until it ends well, telling progress and message. Raises DemoError when it does not."""
    while True:
        job: dict[str, Any] = api.call("GET", f"/v1/jobs/{job_id}").json()
        told(job["progress"], job["message"])
        if job["status"] in FINAL:
            break
        time.sleep(POLL_S)
    if job["status"] != "successful":
        raise DemoError(f"job {job_id} {job['status']}: {job['message']}")
    return job


def mapped_floors(api: Connection, world: World, floor_ids: list[str]) -> list[MappedFloor]:
    """What the server now says of every floor."""
    return [_mapped_floor(api, world, k, floor_id) for k, floor_id in enumerate(floor_ids)]


def ask(api: Connection, building_id: str, questions: list[Question], told: Told) -> list[Answer]:
    """Ask for the position of every window, on any floor and without a prior."""
    answers = []
    for k, question in enumerate(questions):
        start = time.perf_counter()
        fix = api.call("POST", f"/v1/buildings/{building_id}/locate", json=question.body).json()
        answers.append(Answer(question, fix, 1e3 * (time.perf_counter() - start)))
        told(k + 1, len(questions))
    return answers


def _mapped_floor(api: Connection, world: World, index: int, floor_id: str) -> MappedFloor:
    map_id = api.call("GET", f"/v1/floors/{floor_id}").json()["active_map_id"]
    if map_id is None:
        raise DemoError(f"{world.floors[index].name} has no active map although its job ended")
    row = api.call("GET", f"/v1/maps/{map_id}").json()
    exported = np.load(io.BytesIO(api.call("GET", f"/v1/maps/{map_id}/export?format=npz").content), allow_pickle=False)
    layers = {name: np.asarray(exported[name], dtype=np.float64) for name in exported.files}
    error, sd = _true_error_uT(api, world, index, map_id)
    return MappedFloor(
        name=world.floors[index].name,
        index=index,
        floor_id=floor_id,
        map=row,
        quality=api.call("GET", f"/v1/maps/{map_id}/quality").json(),
        layers=layers,
        tracks_m=[_track(api, survey_id) for survey_id in row["survey_ids"]],
        error_uT=error,
        error_sd_uT=sd,
    )


def _track(api: Connection, survey_id: str) -> Array:
    rows = api.call("GET", f"/v1/surveys/{survey_id}/samples", params={"limit": TRACK_SAMPLES}).json()["rows"]
    return np.array(rows, dtype=np.float64)[:, 1:3]


def _true_error_uT(api: Connection, world: World, index: int, map_id: str) -> tuple[Array | None, Array | None]:
    """Map less truth and stated sd at the floor's probes, each (m, 3), for a vector map of a known field."""
    if world.field_uT is None:
        return None, None
    probes = world.probes_m[index]
    answer = api.call("POST", f"/v1/maps/{map_id}/field", json={"points_m": probes.tolist()}).json()
    measured = np.array(answer["measured"], dtype=bool)
    if answer["components"] != ["bx", "by", "bz"] or not measured.any():
        return None, None
    mean = np.array([row for row in answer["mean_ut"] if row is not None])
    sd = np.array([row for row in answer["sd_ut"] if row is not None])
    return mean - world.field_uT(probes[measured]), sd
