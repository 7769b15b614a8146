"""A small building for the viewer's tests: an analytic field, three floors, two organisations."""

import contextlib
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Any, ClassVar

import httpx
import msgspec
import numpy as np
import pytest
import uvicorn
import zstandard
from starlette.applications import Starlette
from starlette.routing import Mount
from websockets.sync.client import ClientConnection as Connection
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from app.errors import NotFound
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components, Samples
from app.services.reach import Reach
from app.viewer.page import COOKIE, ViewerApp
from app.viewer.source import ViewedBuilding, ViewedFloor, ViewedMap, Walk


def make_grid(
    components: Components = "vector",
    height_m: float = 1.2,
    size_m: tuple[float, float] = (24.0, 14.0),
    resolution_m: float = 0.25,
    origin_m: tuple[float, float] = (100.0, 40.0),
    heights: int = 1,
    seed: int = 1,
) -> FieldGrid:
    """A smooth field of a few dipole-like bumps, measured inside an L-shaped corridor."""
    rng = np.random.default_rng(seed)
    nx, ny = (int(s / resolution_m) + 1 for s in size_m)
    x, y = np.meshgrid(np.arange(nx) * resolution_m, np.arange(ny) * resolution_m)
    mean = np.empty((heights, ny, nx, 3))
    mean[:] = (18.0, 4.0, -44.0)
    for _ in range(14):
        cx, cy, width = rng.uniform(0, size_m[0]), rng.uniform(0, size_m[1]), rng.uniform(1.0, 2.5)
        bump = np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * width**2))
        mean += bump[None, :, :, None] * rng.normal(0.0, 14.0, size=3)
    mean *= (1.0 - 0.1 * np.arange(heights))[:, None, None, None]
    measured = ((y < 6.0) | (x < 9.0)) & (np.hypot(x - 15.0, y - 3.0) > 1.5)
    sd = np.where(measured, 1.0 + 0.3 * np.sin(x), 12.0)[None, :, :, None] * np.ones((heights, 1, 1, 3))
    if components == "level":
        mean = np.stack([np.hypot(mean[..., 0], mean[..., 1]), mean[..., 2]], axis=-1)
    elif components == "norm":
        mean = np.linalg.norm(mean, axis=-1, keepdims=True)
    c = len(COMPONENT_NAMES[components])
    gradient = np.stack(np.gradient(mean, resolution_m, axis=(2, 1)), axis=-1)
    return FieldGrid(
        components=components,
        origin_m=origin_m,
        resolution_m=resolution_m,
        heights_m=height_m + 0.5 * np.arange(heights),
        mean_uT=mean.astype(np.float32),
        sd_uT=sd[..., :c].astype(np.float32),
        gradient_uT_per_m=gradient.astype(np.float32),
        measured=np.broadcast_to(measured, mean.shape[:3]).copy(),
        ambient_uT=np.full(c, 10.0),
        prior_sd_uT=np.full(c, 12.0),
        noise_sd_uT=np.full(c, 0.5),
    )


def make_walk(name: str, height_m: float = 1.2, offset_m: float = 0.0) -> Walk:
    """A walk up and down the corridor of `make_grid`."""
    s = np.linspace(0.0, 1.0, 200)
    p = np.column_stack([100.5 + 23.0 * s, 41.0 + offset_m + 0.4 * np.sin(9 * s), np.full(200, height_m)])
    field = make_grid(height_m=height_m).at(p).mean_uT + np.array([0.5, 0.0, 0.0])
    return Walk(survey_id=f"survey-{name}", name=name, samples=Samples(20.0 * s, p, field, "building"))


@dataclass
class MemorySource:
    """A ViewerSource over dictionaries: a third implementation of the protocol, beside the database's."""

    by_organisation: dict[str, list[ViewedBuilding]]
    grids: dict[str, FieldGrid]
    walks_by_floor: dict[str, list[Walk]]
    asked: list[tuple[str, str]] = field(default_factory=list)
    plans: dict[str, bytes] = field(default_factory=dict)

    def buildings(self, reach: Reach) -> list[ViewedBuilding]:
        return [
            b for b in self.by_organisation.get(reach.organisation_id, []) if reach.holds(reach.organisation_id, b.id)
        ]

    def _floors(self, reach: Reach) -> list[ViewedFloor]:
        return [f for b in self.buildings(reach) for f in b.floors]

    def map(self, reach: Reach, map_id: str) -> ViewedMap:
        """The maps of a floor are its active one and those named after it: map-0 and map-0-older."""
        self.asked.append((reach.organisation_id, map_id))
        mine = {f.map_id: f.id for f in self._floors(reach) if f.map_id}
        active = map_id.removesuffix("-older")
        if active not in mine or map_id not in self.grids:
            raise NotFound(f"no map {map_id}")
        grid = self.grids[map_id]
        stored = {"coverage": np.ones(grid.measured.shape, np.float32)} if map_id == "map-0" else {}
        return ViewedMap(mine[active], grid, stored)

    def walks(self, reach: Reach, floor_id: str, known: Mapping[str, Walk]) -> list[Walk]:
        self.asked.append((reach.organisation_id, floor_id))
        if floor_id not in {f.id for f in self._floors(reach)}:
            raise NotFound(f"no floor {floor_id}")
        return [known.get(walk.survey_id, walk) for walk in self.walks_by_floor.get(floor_id, [])]

    def plan_image(self, reach: Reach, floor_id: str) -> bytes:
        self.asked.append((reach.organisation_id, floor_id))
        if floor_id not in {f.id for f in self._floors(reach) if f.plan is not None}:
            raise NotFound(f"no plan of floor {floor_id}")
        return self.plans[floor_id]


@pytest.fixture(scope="session")
def grid_of() -> Callable[..., FieldGrid]:
    return make_grid


@pytest.fixture(scope="session")
def walk_of() -> Callable[..., Walk]:
    return make_walk


@pytest.fixture
def source() -> MemorySource:
    """Organisation "north" has a tower of two mapped floors and one without a map; "south" has a shed."""
    ring = np.array([[99.5, 39.5], [124.5, 39.5], [124.5, 54.5], [99.5, 54.5], [99.5, 39.5]])
    ground = ViewedFloor("floor-0", "Ground", 0, 0.0, (ring,), "map-0", "0" * 64)
    first = ViewedFloor("floor-1", "First", 1, 4.0, (ring,), "map-1", "1" * 64)
    roof = replace(first, id="floor-2", name="Roof", ordinal=2, elevation_m=8.0, map_id=None, grid_sha256=None)
    shed = ViewedFloor("floor-s", "Shed floor", 0, 0.0, (), "map-s", "2" * 64)
    return MemorySource(
        {
            "north": [ViewedBuilding("tower", "Tower", (ground, first, roof)), ViewedBuilding("barn", "Barn", ())],
            "south": [ViewedBuilding("shed", "Secret shed", (shed,))],
        },
        {
            "map-0": make_grid(),
            "map-0-older": make_grid(seed=4),
            "map-1": make_grid(height_m=5.2, seed=2),
            "map-s": make_grid("level", seed=3),
        },
        {"floor-0": [make_walk("lobby"), make_walk("hall", offset_m=2.0)], "floor-1": [make_walk("upstairs", 5.2)]},
    )


@dataclass(frozen=True)
class Who:
    """An identity as the composition root would give it."""

    reach: Reach
    scopes: frozenset[str]


@dataclass
class KeyRing:
    """Keys to identities; a key can be revoked."""

    keys: dict[str, Who]

    def __call__(self, key: str) -> Who | None:
        return self.keys.get(key)


@pytest.fixture
def keys() -> KeyRing:
    return KeyRing(
        {
            "north-key": Who(Reach("north"), frozenset({"map:read"})),
            "barn-key": Who(Reach("north", frozenset({"barn"})), frozenset({"map:read"})),
            "south-key": Who(Reach("south"), frozenset({"admin"})),
            "locate-key": Who(Reach("north"), frozenset({"locate"})),
        }
    )


@dataclass
class RunningViewer:
    """A viewer served for real on loopback, and how to talk to it as a browser would."""

    host: str
    viewer: ViewerApp

    @property
    def url(self) -> str:
        return f"http://{self.host}"

    def client(self) -> httpx.Client:
        return httpx.Client(base_url=self.url, headers={"Origin": self.url}, trust_env=False)

    def cookie(self, key: str) -> str:
        """Sign in and return the cookie header."""
        with self.client() as client:
            answer = client.post("/view/session", data={"key": key})
            assert answer.status_code == 303, answer.text
            return f"{COOKIE}={answer.cookies[COOKIE]}"

    def ask(self, cookie: str, what: str, view: str = "view-0001", **asked: object) -> httpx.Response:
        """What a page asks of its scene."""
        with self.client() as client:
            return client.post(f"/view/scene/{view}/{what}", headers={"Cookie": cookie}, json=asked)

    def websocket(self, cookie: str | None, path: str = "/view/scene/view-0001", origin: str | None = "") -> Connection:
        """A WebSocket as viser's client opens it; `origin` "" is the server's own."""
        return connect(
            f"ws://{self.host}{path}",
            origin=Origin(self.url) if origin == "" else (Origin(origin) if origin else None),
            additional_headers={"Cookie": cookie} if cookie else {},
            subprotocols=[Subprotocol(f"viser-v{version('viser')}")],
            compression=None,
            max_size=None,
            proxy=None,
        )


class Page:
    """viser's client, in so far as the tests need one: tells its camera, decodes what it is sent."""

    CAMERA: ClassVar[dict[str, Any]] = {
        "type": "ViewerCameraMessage", "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [1.0, 1.0, 1.0], "fov": 1.0,
        "image_height": 720, "image_width": 1280, "near": 0.01, "far": 1000.0, "look_at": [0.0, 0.0, 0.0],
        "up_direction": [0.0, 0.0, 1.0],
    }  # fmt: skip

    def __init__(self, connection: Connection) -> None:
        self.connection = connection
        self.messages: list[dict[str, Any]] = []

    def send(self, message: dict[str, Any]) -> None:
        self.connection.send(msgspec.msgpack.encode(message))

    def read_until(self, seen: Callable[["Page"], bool], seconds: float = 15.0) -> None:
        """Read frames until `seen` says so; fails when it does not within the time."""
        end = time.monotonic() + seconds
        while not seen(self):
            self._read(end - time.monotonic())

    def read_for(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        with contextlib.suppress(TimeoutError):
            while True:
                self._read(max(0.0, end - time.monotonic()))

    def _read(self, seconds: float) -> None:
        frame = self.connection.recv(timeout=seconds)
        assert isinstance(frame, bytes)
        length = int.from_bytes(frame[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(
            frame[16 : 16 + length], max_output_size=int.from_bytes(frame[:8], "little")
        )
        self.messages += msgspec.msgpack.decode(inner)["messages"]

    def of_type(self, kind: str) -> list[dict[str, Any]]:
        return [m for m in self.messages if m["type"] == kind]

    def labels(self) -> list[str]:
        return [m["props"]["text"] for m in self.of_type("LabelMessage")]


@pytest.fixture
def open_page() -> Callable[[Connection], Page]:
    """Say hello as viser's client does, and give the page."""

    def open_(connection: Connection) -> Page:
        page = Page(connection)
        page.send(Page.CAMERA)
        return page

    return open_


@pytest.fixture
def serve() -> Iterator[Callable[[ViewerApp], RunningViewer]]:
    """Serve viewers with uvicorn at ephemeral ports of 127.0.0.1 until the test ends."""
    running: list[tuple[uvicorn.Server, threading.Thread]] = []

    def serve_(viewer: ViewerApp) -> RunningViewer:
        @contextlib.asynccontextmanager
        async def lifespan(_: Starlette) -> AsyncIterator[None]:
            yield
            await viewer.close()

        app = Starlette(routes=[Mount("/view", viewer)], lifespan=lifespan)
        listener = socket.create_server(("127.0.0.1", 0))
        server = uvicorn.Server(uvicorn.Config(app, log_level="warning", ws="websockets-sansio", lifespan="on"))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        while not server.started:
            assert thread.is_alive()
            time.sleep(0.01)
        running.append((server, thread))
        return RunningViewer(f"127.0.0.1:{listener.getsockname()[1]}", viewer)

    yield serve_
    for server, thread in running:
        server.should_exit = True
        thread.join(timeout=20)
        assert not thread.is_alive()


@pytest.fixture
def running(serve: Callable[[ViewerApp], RunningViewer], keys: KeyRing, source: MemorySource) -> RunningViewer:
    return serve(ViewerApp(keys, source))
