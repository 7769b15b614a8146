"""How soon somebody sees a large floor: the page in Chromium, on a server that has just started.

A floor of 240 x 220 m at 0.25 m (845,000 cells) is put into a fresh database with its walks. Told, each from a cold
start of the server and a browser without a cache: from asking for the page (just signed in) until the field is seen;
then a second visit, and the change of a layer.
Until the canvas has started the page shows the map from above: that is the first picture; the field in 3-D follows.
The other side is viser alone, in the same browser, with one picture of 200 x 200 points in its scene. Where there is no
graphics processor, most of the time is the browser's own drawing.
"""

import base64
import io
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from app.blobs import FolderBlobStore
from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Building, Floor, Map, Organisation, Survey
from app.field.grid import FieldGrid
from app.field.samples import Samples
from app.services.artefacts import grid_to_bytes, layers_to_bytes, samples_to_bytes
from app.services.manage_keys import create_key
from app.viewer.viser_server import start_viser, stop_viser

KEY = "isd_first-picture"
CHROMIUM = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
COLD_RUNS = 3
CLAIMED_S = 3.0


def grid_of(width_m: float, depth_m: float) -> FieldGrid:
    """Corridors every twelve metres, in a field of waves."""
    r = 0.25
    nx, ny = int(width_m / r) + 1, int(depth_m / r) + 1
    x, y = np.meshgrid(np.arange(nx) * r, np.arange(ny) * r)
    mean = np.stack([18 + 8 * np.sin(0.7 * x + 0.3 * y), 4 + 7 * np.cos(0.5 * x - 0.6 * y),
                     -44 + 9 * np.sin(0.4 * x) * np.cos(0.45 * y)], axis=-1)[None]  # fmt: skip
    measured = (((x % 12.0) < 4.0) | ((y % 12.0) < 4.0))[None]
    gradient = np.stack(np.gradient(mean, r, axis=(2, 1)), axis=-1)
    return FieldGrid(
        components="vector", origin_m=(0.0, 0.0), resolution_m=r, heights_m=np.array([1.2]),
        mean_uT=mean.astype(np.float32), sd_uT=np.where(measured, 0.6, 9.0)[..., None].repeat(3, -1).astype(np.float32),
        gradient_uT_per_m=gradient.astype(np.float32), measured=measured, ambient_uT=np.array([18.0, 4.0, -44.0]),
        prior_sd_uT=np.full(3, 9.0), noise_sd_uT=np.full(3, 0.5),
    )  # fmt: skip


def walks_of(grid: FieldGrid, every_m: float = 12.0) -> list[Samples]:
    """A walk down the middle of every corridor."""
    x0, y0, _, x1, y1, z = grid.bounds_m
    lines = [((x0, y), (x1, y)) for y in np.arange(y0 + 2.0, y1, every_m)]
    lines += [((x, y0), (x, y1)) for x in np.arange(x0 + 2.0, x1, every_m)]
    made = []
    for start, end in lines:
        n = int(np.hypot(end[0] - start[0], end[1] - start[1]) * 10)
        s = np.linspace(0.0, 1.0, n)[:, None]
        p = np.hstack([(1 - s) * np.array(start) + s * np.array(end), np.full((n, 1), z)])
        made.append(Samples(np.arange(n) * 0.1, p, grid.at(p).mean_uT, "building"))
    return made


def fill(folder: Path, width_m: float, depth_m: float) -> str:
    """A database with one surveyed and mapped floor; its id."""
    folder.mkdir()
    engine = create_database_engine(f"sqlite:///{folder / 'isodyn.db'}")
    migrate(engine)
    blobs, grid = FolderBlobStore(folder / "blobs"), grid_of(width_m, depth_m)
    layers = {
        "coverage": np.ones(grid.measured.shape, np.float32),
        "conflict": np.ones(grid.measured.shape, np.float32),
    }
    with session_factory(engine).begin() as session:
        create_key(session, organisation="default", name="bench", scopes=["admin"], secret=KEY)
        session.flush()
        owner = session.query(Organisation).one().id
        building = Building(organisation_id=owner, name="Large")
        session.add(building)
        session.flush()
        floor = Floor(organisation_id=owner, building_id=building.id, name="Hall", ordinal=0, elevation_m=0.0)
        session.add(floor)
        session.flush()
        row = Map(
            organisation_id=owner, floor_id=floor.id, status="ready", spec={"engine": "hilbert"}, survey_ids=[],
            components="vector", grid_sha256=blobs.put(grid_to_bytes(grid)),
            layers_sha256=blobs.put(layers_to_bytes(layers)),
        )  # fmt: skip
        session.add(row)
        session.flush()
        floor.active_map_id = row.id
        for k, samples in enumerate(walks_of(grid)):
            session.add(Survey(
                organisation_id=owner, floor_id=floor.id, name=f"corridor {k}", format="csv", frame="building",
                raw_sha256=f"{k:064d}", samples_sha256=blobs.put(samples_to_bytes(samples)), sample_count=len(samples),
                report={},
            ))  # fmt: skip
        floor_id = floor.id
    engine.dispose()
    return floor_id


class Server:
    """`isodyn serve --no-worker` on a folder, started anew each time."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.url, self.folder = f"http://127.0.0.1:{self.port}", folder

    def __enter__(self) -> "Server":
        environment = {**os.environ, "ISODYN_DATA_DIR": str(self.folder)}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "app.cli", "serve", "--no-worker", "--port", str(self.port)], env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        while True:
            try:
                if httpx.get(f"{self.url}/healthz", trust_env=False).status_code == 200:
                    return self
            except httpx.TransportError:
                time.sleep(0.05)

    def __exit__(self, *_: object) -> None:
        os.killpg(self.process.pid, signal.SIGTERM)
        self.process.wait()


class Film:
    """What the page shows as it is shown, by the browser's own screencast: to take screenshots would slow it down."""

    def __init__(self, page: Page) -> None:
        self._page, self._seen_at = page, None

    def _look(self, frame: dict[str, Any]) -> None:
        self._session.send("Page.screencastFrameAck", {"sessionId": frame["sessionId"]})
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(frame["data"]))).convert("RGB")).astype(int)
        stage = picture[40:250, : int(0.7 * picture.shape[1])]  # without buttons, legend and panel
        if self._seen_at is None and (np.ptp(stage, axis=-1) > 50).mean() > 0.05:
            self._seen_at = time.perf_counter()

    def visit(self, url: str) -> float:
        """Seconds from asking for a page until there is colour on it."""
        self._seen_at, start = None, time.perf_counter()
        self._page.goto(url, wait_until="commit")
        self._session = self._page.context.new_cdp_session(self._page)
        self._session.on("Page.screencastFrame", self._look)
        self._session.send("Page.startScreencast", {"format": "jpeg", "quality": 50, "maxWidth": 640, "maxHeight": 360})
        while self._seen_at is None:
            assert time.perf_counter() - start < 30.0
            self._page.wait_for_timeout(20)
        self._session.detach()
        return self._seen_at - start


def visit(browser: Browser, url: str, floor: str) -> list[float]:
    """Seconds until the first picture and until the field in 3-D, of a first visit and of a second; then of a layer."""
    page = browser.new_context(viewport={"width": 1280, "height": 720}).new_page()
    page.context.request.post(f"{url}/view/session", form={"key": KEY}, headers={"Origin": url}, max_redirects=0)
    film, seen = Film(page), []
    for _ in range(2):
        start = time.perf_counter()
        seen.append(film.visit(f"{url}/view/?floor={floor}"))
        page.locator("#poster.gone").wait_for(state="attached")
        seen.append(time.perf_counter() - start)
        page.goto("about:blank")
        page.wait_for_timeout(2000)
    page.goto(f"{url}/view/?floor={floor}")
    page.locator("#poster.gone").wait_for(state="attached")
    page.wait_for_timeout(1000)
    start = time.perf_counter()
    page.get_by_label("Layer").select_option("sd")
    page.locator("#legend .legend-of", has_text="Uncertainty").wait_for()
    seen.append(time.perf_counter() - start)
    page.context.close()
    return seen


def visit_viser_alone(browser: Browser, url: str) -> list[float]:
    page = browser.new_context(viewport={"width": 905, "height": 720}).new_page()
    film, seen = Film(page), []
    for _ in range(2):
        seen.append(film.visit(url))
        page.goto("about:blank")
        page.wait_for_timeout(2000)
    page.context.close()
    return seen


def main() -> None:
    with TemporaryDirectory() as scratch, sync_playwright() as playwright:
        folder = Path(scratch) / "large"
        floor = fill(folder, 240.0, 220.0)
        bare = start_viser()
        bare.scene.add_image("/picture", np.full((200, 200, 3), (33, 145, 140), np.uint8), 8.0, 8.0)
        rows, bare_rows = [], []
        for _ in range(COLD_RUNS):
            browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
            with Server(folder) as server:
                rows.append(visit(browser, server.url, floor))
            browser.close()
            browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=CHROMIUM)
            bare_rows.append(visit_viser_alone(browser, f"http://127.0.0.1:{bare.get_port()}/"))
            browser.close()
        stop_viser(bare)
        first, solid, again, solid_again, layer = np.median(rows, axis=0)
        each = ", ".join(f"{row[0]:.2f}" for row in rows)
        print(f"240 x 220 m, everything cold: first picture {first:.2f} s ({each}), in 3-D {solid:.2f} s")
        print(f"second visit: {again:.2f} s, in 3-D {solid_again:.2f} s; another layer {layer:.2f} s")
        alone, alone_again = np.median(bare_rows, axis=0)
        print(f"viser alone with one picture: {alone:.2f} s, second visit {alone_again:.2f} s")
        print(
            f"the page's 3-D over viser alone: {solid / alone:.2f} times, second visit {solid_again / alone_again:.2f}"
        )
        sys.exit(first > CLAIMED_S)


if __name__ == "__main__":
    main()
