"""A real server with a small surveyed building, and a real browser in front of it."""

import io
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page

from app.cli.demo.synthetic import synthetic_world
from app.cli.demo.world import World

GALLERY = Path(__file__).parents[2] / "docs" / "pictures"
KEY = "isd_browser-tests"
USUAL = (1280, 720) if os.environ.get("ISODYN_GALLERY") else (960, 600)  # fewer pixels are drawn sooner


@dataclass
class Town:
    """The server's address, keys of two organisations, and what was surveyed.

    floors, maps  ids by floor index; the synthetic world they were made from
    """

    url: str
    key: str
    other_key: str
    building: str
    floors: list[str]
    world: World
    api: httpx.Client
    reader_key: str = ""

    def map_of(self, floor: int) -> str:
        return str(self.api.get(f"/v1/floors/{self.floors[floor]}").json()["active_map_id"])


@pytest.fixture(scope="session")
def town(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Town]:
    """`isodyn serve` on a folder of its own, with a building of two floors surveyed by four walks each."""
    folder = tmp_path_factory.mktemp("town")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {**os.environ, "ISODYN_DATA_DIR": str(folder / "var"), "ISODYN_ADMIN_KEY": KEY}
    with (folder / "server.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "app.cli", "serve", "--port", str(port)], env=environment, stdout=log, stderr=log,
            start_new_session=True,
        )  # fmt: skip
    url = f"http://127.0.0.1:{port}"
    api = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {KEY}"}, timeout=120, trust_env=False)
    try:
        _wait_for(lambda: api.get("/readyz").status_code == 200, lambda: (folder / "server.log").read_text())
        rng = np.random.default_rng(7)
        world = synthetic_world(rng, width_m=24.0, depth_m=16.0, floors=2, windows=8, told=lambda done, total: None)
        building, floors = _survey(api, world)
        town = Town(url, KEY, _new_key(environment, "elsewhere", "admin"), building, floors, world, api)
        town.reader_key = _new_key(environment, "default", "map:read")
        yield town
        assert "Traceback" not in (folder / "server.log").read_text()
    finally:
        api.close()
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=40)


def _survey(api: httpx.Client, world: World) -> tuple[str, list[str]]:
    building = api.post("/v1/buildings", json={"name": world.building}).json()["id"]
    floors, jobs = [], []
    for floor in world.floors:
        floors.append(api.post(f"/v1/buildings/{building}/floors", json=floor.body).json()["id"])
        for survey in floor.surveys:
            answer = api.post(
                f"/v1/floors/{floors[-1]}/surveys", params={"format": survey.format, "name": survey.name},
                headers={"Content-Encoding": "gzip"}, content=survey.gzipped,
            )  # fmt: skip
            jobs.append(answer.json()["job"]["id"])
    for job in jobs:
        _wait_for(partial(_is_done, api, job), lambda: f"jobs {jobs} are not done")
    return building, floors


def _is_done(api: httpx.Client, job: str) -> bool:
    return bool(api.get(f"/v1/jobs/{job}").json()["status"] == "successful")


def _new_key(environment: dict[str, str], organisation: str, scope: str) -> str:
    command = [sys.executable, "-m", "app.cli", "keys", "create", "--organisation", organisation, "--scope", scope,
               f"{scope} of tests"]  # fmt: skip
    made = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return re.search(r"isd_[A-Za-z0-9_-]+", made.stdout).group()  # type: ignore[union-attr]


def _wait_for(seen: Callable[[], bool], told: Callable[[], str], seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            if seen():
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise AssertionError(told())


class Seat:
    """Somebody in front of the page: a browser context of their own."""

    def __init__(self, town: Town, browser: Browser, width: int = USUAL[0], height: int = USUAL[1]) -> None:
        self.town = town
        self.page: Page = browser.new_context(viewport={"width": width, "height": height}).new_page()
        self.faults: list[str] = []
        self.page.on("pageerror", lambda error: self.faults.append(str(error)))
        self.page.set_default_timeout(30_000)

    def sign_in(self, query: str = "", key: str | None = None) -> None:
        self.page.goto(f"{self.town.url}/view/{query}")
        self.page.get_by_label("API key").fill(key or self.town.key)
        self.page.get_by_role("button", name="Sign in").click()

    def open(self, query: str = "", key: str | None = None) -> "Seat":
        """Signed in, and the first picture drawn."""
        self.sign_in(query, key)
        self.page.locator("#legend .legend-of").first.wait_for()
        self.settled()
        return self

    def settled(self) -> NDArray[np.uint8]:
        """The canvas once it stays the same and shows something."""
        before, end = self.canvas(), time.monotonic() + 30.0
        while time.monotonic() < end:
            self.page.wait_for_timeout(200)
            now = self.canvas()
            if (
                self.page.locator("#busy").is_hidden()
                and (now != before).any(axis=-1).mean() < 1e-3
                and colourful_share(now) > 0.02
            ):
                return now
            before = now
        raise AssertionError(f"the canvas shows {colourful_share(before):.1%} colour; the page reported {self.faults}")

    def canvas(self) -> NDArray[np.uint8]:
        """(rows, columns, 3) what is on the stage, legend and buttons included."""
        picture = self.page.locator("#stage").screenshot()
        return np.asarray(Image.open(io.BytesIO(picture)).convert("RGB"))

    def choose_floor(self, floor: int) -> None:
        self.page.locator("#floor").select_option(self.town.floors[floor])
        self.page.locator("#words").get_by_text(self.town.world.floors[floor].body["name"]).wait_for()
        self.settled()

    def tab(self, name: str) -> None:
        self.page.get_by_role("tab", name=name).click()

    def keep(self, name: str) -> None:
        """A picture for the gallery of the documentation, when one is being made."""
        if os.environ.get("ISODYN_GALLERY"):
            picture = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
            picture.save(GALLERY / f"{name}.jpg", quality=88, subsampling=0, optimize=True)

    def drop(self, place: str, name: str, data: bytes) -> None:
        """Drop a file on a place of the page."""
        files = self.page.evaluate_handle(
            """([name, bytes]) => {
              const files = new DataTransfer();
              files.items.add(new File([new Uint8Array(bytes)], name));
              return files;
            }""",
            [name, list(data)],
        )
        self.page.dispatch_event(place, "drop", {"dataTransfer": files})


def colourful_share(picture: NDArray[np.uint8]) -> float:
    """The share of a picture that is neither background nor grey: how much field is to be seen."""
    return float((np.ptp(picture.astype(np.int16), axis=-1) > 50).mean())


@pytest.fixture
def seat(town: Town, browser: Browser) -> Iterator[Callable[..., Seat]]:
    """Make a seat; nothing may have gone wrong in any page when the test ends."""
    seats: list[Seat] = []

    def make(**size: Any) -> Seat:
        seats.append(Seat(town, browser, **size))
        return seats[-1]

    yield make
    for each in seats:
        each.page.context.close()
        assert each.faults == []
