"""A real application on a real database and blob folder, both kinds of database, without a worker process: jobs are
run by calling the worker's own verbs. `tests/end_to_end` has the same with every process."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi import FastAPI
from sqlalchemy import select
from starlette.testclient import TestClient
from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.context import Context
from app.db.tables import Base, Job
from app.main import create_app, first_start
from app.services.build_map import claim_build, fit_build, publish_build
from app.services.manage_keys import create_key
from app.settings import Settings
from app.synthetic.hall import hall_uT

ADMIN = "isd_admin-of-the-first-organisation"
STRANGER = "isd_admin-of-another-organisation"
HEADER = "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut"


def make_walk_csv(seed: int, width_m: float = 12.0, depth_m: float = 8.0, offset_m: float = 0.0) -> bytes:
    """A lawn-mower walk over a small floor, 0.8 m lanes, as a canonical file."""
    rng = np.random.default_rng(seed)
    xs = np.arange(0.0, width_m, 0.2)
    lanes = np.arange(offset_m, depth_m, 0.8)
    x = np.concatenate([xs if k % 2 == 0 else xs[::-1] for k in range(len(lanes))])
    y = np.repeat(lanes, len(xs))
    B = hall_uT(x, y) + rng.normal(0, 0.3, (len(x), 3))
    t = 0.2 * np.arange(len(x))
    rows = np.column_stack([t, x, y, np.full(len(x), 1.2), B])
    return (HEADER + "\n" + "\n".join(",".join(f"{v:.4f}" for v in row) for row in rows) + "\n").encode()


@dataclass(frozen=True)
class Service:
    """The application as its users have it, and its insides for the assertions."""

    http: TestClient
    app: FastAPI
    context: Context

    def run_jobs(self) -> None:
        """What a worker does with every waiting job."""
        while True:
            with self.context.transaction() as session:
                job_id = session.scalars(select(Job.id).where(Job.status == "accepted").order_by(Job.id)).first()
                if job_id is None:
                    return
                plan = claim_build(session, job_id)
            result = fit_build(plan, self.context.blobs, lambda fraction, message: None)
            with self.context.transaction() as session:
                publish_build(session, job_id, plan, result)

    def row_counts(self) -> dict[str, int]:
        """Rows of every table, to show that nothing was stored."""
        with self.context.transaction() as session:
            return {t.name: len(session.execute(select(t)).all()) for t in Base.metadata.sorted_tables}

    def blob_count(self) -> int:
        return sum(1 for _ in self.context.blobs.stored())


class Logged:
    """Errors that nobody handles go to the log, as a server has them; the test client drops them without a word."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await self.app(scope, receive, send)
        except Exception:
            logging.getLogger("tests.api").exception("%s %s failed", scope.get("method"), scope.get("path"))
            raise


@pytest.fixture(scope="module")
def service(database_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder: Path = tmp_path_factory.mktemp("data")
    settings = Settings(
        data_dir=folder, database_url=database_url, admin_key=ADMIN, max_body_bytes=2**20, max_upload_bytes=2**21
    )
    first_start(settings)
    app = create_app(settings)
    context: Context = app.state.context
    with context.transaction() as session:
        create_key(session, organisation="another", name="stranger", scopes=["admin"], secret=STRANGER)
    with TestClient(Logged(app), headers={"Authorization": f"Bearer {ADMIN}"}, raise_server_exceptions=False) as http:
        yield Service(http, app, context)


@pytest.fixture(scope="session")
def walk_csv() -> Callable[..., bytes]:
    """A small walk as a canonical file, by seed."""
    return make_walk_csv


@pytest.fixture(scope="session")
def true_field_uT() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return hall_uT


@pytest.fixture(scope="session")
def stranger() -> dict[str, str]:
    """Headers of an admin key of another organisation."""
    return {"Authorization": f"Bearer {STRANGER}"}


@pytest.fixture(scope="module")
def key_with(service: Service) -> Callable[..., dict[str, str]]:
    """Headers of a new key of the first organisation with these scopes."""

    def make(*scopes: str, name: str = "test", **more: Any) -> dict[str, str]:
        with service.context.transaction() as session:
            key = create_key(session, **{"organisation": "default"} | more, name=name, scopes=scopes)
        return {"Authorization": f"Bearer {key}"}

    return make


@pytest.fixture(scope="module")
def building(service: Service) -> str:
    return str(service.http.post("/v1/buildings", json={"name": "House"}).json()["id"])


def make_floor(service: Service, building: str, **more: object) -> str:
    body = {"name": "Ground", "ordinal": 0, "elevation_m": 0.0, **more}
    answer = service.http.post(f"/v1/buildings/{building}/floors", json=body)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


@pytest.fixture
def new_floor(service: Service, building: str) -> Callable[..., str]:
    """Make an empty floor."""
    return lambda **more: make_floor(service, building, **more)


@pytest.fixture(scope="module")
def mapped_floor(service: Service, building: str) -> str:
    """A floor with three surveys and an active map."""
    floor = make_floor(service, building)
    for seed in (1, 2, 3):
        answer = service.http.post(f"/v1/floors/{floor}/surveys", content=make_walk_csv(seed, offset_m=0.25 * seed))
        assert answer.status_code == 202, answer.text
    service.run_jobs()
    return floor


@pytest.fixture(scope="module")
def active_map(service: Service, mapped_floor: str) -> str:
    return str(service.http.get(f"/v1/floors/{mapped_floor}").json()["active_map_id"])


@pytest.fixture(scope="module")
def ids(service: Service, building: str, mapped_floor: str, active_map: str) -> dict[str, str]:
    """An object of every kind there is, of the first organisation, by the name that paths have for its id."""
    http = service.http
    track = http.post("/v1/tracks", json={"floor_ids": [mapped_floor], "frame": "norm", "name": "a lift"}).json()["id"]
    rng = np.random.default_rng(0)
    turned = rng.normal(size=(200, 3))
    readings = 50.0 * (turned / np.linalg.norm(turned, axis=1, keepdims=True) + rng.normal(0, 0.001, (200, 3)))
    reference = {"magnitude_ut": 50.0}
    body = {"device": "phone", "method": "ellipsoid", "reference": reference, "b_ut": readings.tolist()}
    return {
        "calibration_id": http.post("/v1/calibrations", json=body).json()["id"],
        "track_id": track,
        "building_id": building,
        "floor_id": mapped_floor,
        "map_id": active_map,
        "survey_id": http.get(f"/v1/floors/{mapped_floor}/surveys").json()["items"][0]["id"],
        "job_id": http.get("/v1/jobs", params={"floor_id": mapped_floor}).json()["items"][0]["id"],
        "key_id": http.post("/v1/keys", json={"name": "spare", "scopes": ["map:read"]}).json()["id"],
    }
