"""What all tests share: throw-away databases of both kinds, and a blob folder.

PostgreSQL is taken from ISODYN_TEST_POSTGRES_URL (default: the server on this machine). Without one its tests are
skipped, but never silently where `CI` is set: there a missing server is a failure.
"""

import asyncio
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np
import pytest
from hypothesis import settings
from sqlalchemy import Engine, create_engine, make_url, text
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session, sessionmaker
from threadpoolctl import threadpool_limits

from app.blobs import BlobStore, FolderBlobStore
from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Building, Floor, Map, Organisation
from app.field.grid import FieldGrid
from app.services.artefacts import grid_to_bytes
from app.synthetic.hall import HALL_CORNERS_M, hall_map, hall_uT
from tests.s3_server import ENVIRONMENT, Server, started

if TYPE_CHECKING:
    from playwright.sync_api import Browser

settings.register_profile("untimed", deadline=None)  # how fast a machine is, is no test's business
settings.load_profile("untimed")

CHROMIUM = Path("/usr/bin/chromium")
POSTGRES_URL = os.environ.get("ISODYN_TEST_POSTGRES_URL", "postgresql+psycopg://root@127.0.0.1:5432/postgres")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests marked `browser` are skipped where there is none, but never where `CI` is set."""
    if not CHROMIUM.exists() and not os.environ.get("CI"):
        for item in items:
            if item.get_closest_marker("browser"):
                item.add_marker(pytest.mark.skip(reason=f"no browser at {CHROMIUM}: apt-get install chromium"))


@pytest.fixture(scope="session")
def hall_grid() -> FieldGrid:
    """Its map, as good as a map can be, and 3 m more on every side."""
    return hall_map()


@pytest.fixture(scope="session")
def put_hall(hall_grid: FieldGrid) -> Callable[[Session, BlobStore], tuple[str, str]]:
    """Put the hall and its active map into a database: ids of building and floor, of the organisation "default"."""

    def put(session: Session, blobs: BlobStore) -> tuple[str, str]:
        owner = session.query(Organisation).filter_by(name="default").one().id
        building = Building(organisation_id=owner, name="Hall")
        session.add(building)
        session.flush()
        floor = Floor(organisation_id=owner, building_id=building.id, name="Ground", ordinal=0, elevation_m=0.0)
        session.add(floor)
        session.flush()
        made = Map(
            organisation_id=owner, floor_id=floor.id, status="ready", spec={}, survey_ids=[], components="vector",
            grid_sha256=blobs.put(grid_to_bytes(hall_grid)),
        )  # fmt: skip
        session.add(made)
        session.flush()
        floor.active_map_id = made.id
        return building.id, floor.id

    return put


@pytest.fixture(scope="session")
def hall_steps() -> Callable[..., list[dict[str, Any]]]:
    """Steps of a device carried through the hall, ten a second and metre, as a client sends them."""
    corners = HALL_CORNERS_M
    turn = 0.7  # of the level frame

    def make(frame: str = "level", count: int = 300, seed: int = 5) -> list[dict[str, Any]]:
        legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        at = 0.1 * np.arange(count)
        p = np.stack([np.interp(at, np.concatenate([[0], np.cumsum(legs)]), corners[:, k]) for k in (0, 1)], axis=1)
        B = hall_uT(p[:, 0], p[:, 1]) + np.random.default_rng(seed).normal(0.0, 0.3, (count, 3))
        level = frame in ("level", "norm")
        c, s = (np.cos(turn), np.sin(turn)) if level else (1.0, 0.0)
        back = np.array([[c, -s], [s, c]])
        moved = (p - p[0]) @ back
        heading = np.unwrap(np.arctan2(np.gradient(p[:, 1]), np.gradient(p[:, 0])))
        yaw = heading if frame == "body" else np.zeros(count)
        cy, sy = np.cos(yaw), np.sin(yaw)
        flat = B[:, :2] @ back
        told = np.column_stack([cy * flat[:, 0] + sy * flat[:, 1], cy * flat[:, 1] - sy * flat[:, 0], B[:, 2]])
        more = [{"yaw_rad": float(h - heading[0])} for h in heading]
        if frame == "body":
            more = [{"orientation": [float(np.cos(h / 2)), 0.0, 0.0, float(np.sin(h / 2))]} for h in heading]
        return [
            {"number": k, "t_s": float(at[k]), "displacement_m": [*moved[k].tolist(), 0.0],
             "b_ut": float(np.linalg.norm(told[k])) if frame == "norm" else told[k].tolist(), **more[k]}
            for k in range(count)
        ]  # fmt: skip

    return make


@pytest.fixture(scope="session")
def hall_place_m() -> Callable[[int], np.ndarray]:
    """Where the device truly was at a step of `hall_steps`: (2,)."""
    corners = HALL_CORNERS_M
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    return lambda step: np.array([np.interp(0.1 * step, along, corners[:, k]) for k in (0, 1)])


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    """Chromium, drawing in software: one for all tests, because a process can hold only one."""
    from playwright.sync_api import sync_playwright

    arguments = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
                 "--disable-component-update", "--disable-sync", "--use-gl=angle", "--use-angle=swiftshader",
                 "--enable-unsafe-swiftshader"]  # fmt: skip
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        yield browser
        browser.close()


@pytest.fixture(autouse=True)
def no_loop_of_the_browser(request: pytest.FixtureRequest) -> Iterator[None]:
    """The browser keeps an event loop marked as running in its thread, where tests without it start their own."""
    running = asyncio._get_running_loop()
    if running is None or "browser" in request.fixturenames:
        yield
        return
    asyncio._set_running_loop(None)
    yield
    asyncio._set_running_loop(running)


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread() -> Iterator[None]:
    """As in the workers: small matrices are many times slower on several threads than on one."""
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="module")
def sqlite_url(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The address of an empty SQLite database, one per test module."""
    return f"sqlite:///{tmp_path_factory.mktemp('database') / 'isodyn.db'}"


@pytest.fixture(scope="module")
def postgres_url() -> Iterator[str]:
    """The address of an empty PostgreSQL database, one per test module, dropped afterwards."""
    server = create_engine(POSTGRES_URL, isolation_level="AUTOCOMMIT", connect_args={"connect_timeout": 5})
    name = f"isodyn_test_{uuid4().hex[:12]}"
    try:
        with server.connect() as connection:
            connection.execute(text(f"CREATE DATABASE {name}"))
    except OperationalError as error:
        reason = f"no PostgreSQL server at {POSTGRES_URL} (set ISODYN_TEST_POSTGRES_URL): {error.orig}"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    try:
        yield make_url(POSTGRES_URL).set(database=name).render_as_string(hide_password=False)
    finally:
        with server.connect() as connection:
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
        server.dispose()


@pytest.fixture(scope="session")
def s3_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server of the S3 API with a bucket, for all tests of this process."""
    server = started(tmp_path_factory.mktemp("s3") / "server.log")
    yield server
    server.stop()


@pytest.fixture(scope="module")
def s3(s3_server: Server) -> Iterator[Server]:
    """The same, and the environment leads there."""
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith("AWS_")]:
            patch.delenv(name)
        for name, value in {**ENVIRONMENT, "AWS_ENDPOINT_URL": s3_server.url}.items():
            patch.setenv(name, value)
        yield s3_server


@pytest.fixture(scope="module", params=["sqlite", pytest.param("postgres", marks=pytest.mark.postgres)])
def database_url(request: pytest.FixtureRequest) -> str:
    """The address of an empty database, once of each kind."""
    url: str = request.getfixturevalue(f"{request.param}_url")
    return url


@pytest.fixture(scope="module")
def engine(database_url: str) -> Iterator[Engine]:
    """A migrated database, once of each kind."""
    migrate(database_url)
    engine = create_database_engine(database_url)
    yield engine
    engine.dispose()


@pytest.fixture(scope="module")
def sessions(engine: Engine) -> sessionmaker[Session]:
    return session_factory(engine)


@pytest.fixture
def blob_store(tmp_path: Path) -> FolderBlobStore:
    return FolderBlobStore(tmp_path / "blobs")
