"""`isodyn view` as a user types it: of an exported file without a server, of a server over HTTP."""

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from typer.testing import CliRunner

from app.cli import main
from app.field.grid import FieldGrid
from app.services.export_map import export_map

runner = CliRunner()


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    for name in ("ISODYN_KEY", "ISODYN_URL"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path


@pytest.fixture
def exported(folder: Path) -> Path:
    rng = np.random.default_rng(1)
    shape = (2, 12, 20)
    grid = FieldGrid(
        "norm", (0.0, 0.0), 0.5, np.array([0.4, 1.2]), rng.normal(45, 3, (*shape, 1)).astype(np.float32),
        np.ones((*shape, 1), np.float32), np.zeros((*shape, 1, 2), np.float32), np.ones(shape, bool), np.full(1, 45.0),
        np.full(1, 5.0), np.full(1, 0.5),
    )  # fmt: skip
    path = folder / "lobby.nc"
    path.write_bytes(export_map(grid, "netcdf", "0" * 64))
    return path


def test_a_file_becomes_a_page_beside_it_without_a_server(exported: Path, folder: Path) -> None:
    result = runner.invoke(main, ["view", str(exported)])
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("lobby.html: ")
    page = (folder / "lobby.html").read_text(encoding="utf-8")
    assert "<h1>lobby</h1>" in page
    assert "1.20 m</option>" in page


def test_the_page_goes_where_it_is_told_and_opens_when_asked(exported: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert runner.invoke(main, ["view", str(exported), "--output", "a.html"]).exit_code == 0
    assert opened == []  # stdout is no terminal
    assert runner.invoke(main, ["view", str(exported), "--output", "b.html", "--open"]).exit_code == 0
    assert opened == [Path("b.html").resolve().as_uri()]


def test_a_picture_of_the_layer_and_height_asked_for(exported: Path) -> None:
    result = runner.invoke(main, ["view", str(exported), "--png", "sd.png", "--layer", "sd", "--height-m", "1.3"])
    assert result.exit_code == 0, result.output
    assert Path("sd.png").read_bytes().startswith(b"\x89PNG")
    assert not Path("lobby.html").exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["lobby.nc", "--png", "x.png", "--layer", "bx"], "ask for one of norm"),
        (["lobby.nc", "--png", "x.png", "--height-m", "9"], "0.40, 1.20 m"),
        (["lobby.nc", "--png", "x.png", "--output", "x.html"], "give one of them"),
        (["nowhere.nc"], "No such file"),
        (["some-map-id"], "--key"),
    ],
)
def test_refusals_are_sentences(exported: Path, arguments: list[str], says: str) -> None:
    result = runner.invoke(main, ["view", *arguments])
    assert result.exit_code == 2
    assert says in result.output
    assert "Traceback" not in result.output


class OneMap(BaseHTTPRequestHandler):
    """A server that has a page and a picture, and remembers what it was asked."""

    asked: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        self.asked.append(f"{self.path} {self.headers['Authorization']}")
        self.send_response(200)
        self.end_headers()
        self.wfile.write(b"<html>" if "view.html" in self.path else b"\x89PNG")

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    OneMap.asked.clear()
    server = HTTPServer(("127.0.0.1", 0), OneMap)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


def test_a_map_of_a_server_is_asked_for_by_its_id(server: str) -> None:
    whose = ["--url", server, "--key", "isd_k"]
    assert runner.invoke(main, ["view", "m1", *whose]).exit_code == 0
    assert Path("m1.html").read_bytes() == b"<html>"
    assert runner.invoke(main, ["view", "m1", *whose, "--png", "m1.png", "--height-m", "1.2"]).exit_code == 0
    assert OneMap.asked == [
        "/v1/maps/m1/view.html Bearer isd_k",
        "/v1/maps/m1/heatmap.png?layer=norm&height_m=1.2 Bearer isd_k",
    ]
