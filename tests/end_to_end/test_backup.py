"""An installation is backed up as it runs, restored into another database, and answers there as it did."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

PATHS = (
    "/v1/buildings", "/v1/calibrations", "/v1/floors/{floor}", "/v1/floors/{floor}/surveys", "/v1/floors/{floor}/maps",
    "/v1/maps/{map}", "/v1/maps/{map}/quality", "/v1/maps/{map}/export?format=csv", "/v1/surveys/{survey}/samples",
    "/v1/jobs/{job}", "/v1/tracks/{track}/replay",
)  # fmt: skip
WINDOW = {
    "window": {
        "frame": "level", "noise_ut": 0.5,
        "b_ut": [[18.0 + 0.5 * k, 3.0, -42.0 - 0.3 * k] for k in range(12)],
        "displacement_m": [[0.25 * k, 0.0, 0.0] for k in range(12)],
    }
}  # fmt: skip


def isodyn(environment: dict[str, str], *arguments: object) -> tuple[int, str]:
    ended = subprocess.run(
        [sys.executable, "-m", "app.cli", *map(str, arguments)], env={**environment, "COLUMNS": "200"},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return ended.returncode, ended.stdout + ended.stderr


def answers(server: Any, names: dict[str, str], building: str) -> list[Any]:
    said = [server.http.get(path.format(**names)) for path in PATHS[:-1]]
    said.append(server.http.post(PATHS[-1].format(**names)))
    fix = server.http.post(f"/v1/buildings/{building}/locate", json=WINDOW)
    assert {each.status_code for each in (*said, fix)} == {200}, [each.text[:200] for each in said]
    return [*(each.content for each in said), {**fix.json(), "timing_ms": None}]


@pytest.fixture
def second(server: Any, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Callable[[str], Any]]:
    """Another installation's server, not yet started, by the kind of its database."""
    made: list[Any] = []

    def make(kind: str) -> Any:
        folder = tmp_path / f"installation {len(made)}"
        folder.mkdir()
        url = None if kind == "sqlite" else request.getfixturevalue("postgres_url")
        made.append(type(server)(folder, url))
        return made[-1]

    yield make
    for each in made:
        each.http.close()
        if each.process is not None:
            each.kill()


@pytest.mark.postgres
@pytest.mark.slow
def test_answers_are_the_same_on_postgresql_and_on_sqlite_again(
    server: Any, second: Callable[[str], Any], walk_csv: Callable[[int], bytes],
    hall_steps: Callable[..., list[dict[str, Any]]], tmp_path: Path,
) -> None:  # fmt: skip
    floor = server.new_floor()
    building = server.http.get(f"/v1/floors/{floor}").json()["building_id"]
    sent = server.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1)).json()
    assert server.wait_for(sent["job"]["id"])["status"] == "successful"
    track = server.http.post("/v1/tracks", json={"building_id": building, "frame": "level"}).json()["id"]
    assert server.http.post(f"/v1/tracks/{track}/steps", json={"steps": hall_steps(count=40)}).status_code == 200
    turned = [[x, y, z] for x in (-20.0, 30.0, 5.0) for y in (-31.0, 20.0, 4.0) for z in (-40.0, 28.0, 9.0)] * 4
    device = {"device": "d", "method": "ellipsoid", "b_ut": turned, "reference": {"magnitude_ut": 45.0}}
    server.http.post("/v1/calibrations", json=device)
    names = {
        "floor": floor, "survey": sent["survey"]["id"], "job": sent["job"]["id"], "track": track,
        "map": server.http.get(f"/v1/floors/{floor}").json()["active_map_id"],
    }  # fmt: skip
    before = answers(server, names, building)

    code, said = isodyn(server.environment, "backup", tmp_path / "1.zip")
    assert code == 0, said
    there = second("postgres")
    code, said = isodyn(there.environment, "restore", tmp_path / "1.zip")
    assert code == 0, said
    there.start()
    assert answers(there, names, building) == before
    code, said = isodyn(there.environment, "backup", tmp_path / "2.zip")
    assert code == 0, said
    back = second("sqlite")
    code, said = isodyn(back.environment, "restore", tmp_path / "2.zip")
    assert code == 0, said
    back.start()
    assert answers(back, names, building) == before
    more = back.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(2)).json()
    assert back.wait_for(more["job"]["id"])["status"] == "successful"
    code, said = isodyn(back.environment, "doctor", "--deep")
    assert code == 0, said
    assert "missing" not in said


@pytest.mark.slow
def test_jobs_that_ran_when_the_backup_was_made_end_after_the_restore(
    server: Any, second: Callable[[str], Any], walk_csv: Callable[[int], bytes], tmp_path: Path
) -> None:
    floor = server.new_floor()
    first = server.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1)).json()["job"]["id"]
    server.wait_for(first, "running")
    waiting = server.http.post(f"/v1/floors/{floor}/maps", json={"resolution_m": 0.5}).json()["job"]["id"]
    code, said = isodyn(server.environment, "backup", tmp_path)
    assert code == 0, said
    (archive,) = tmp_path.glob("isodyn-*.zip")
    there = second("sqlite")
    code, said = isodyn(there.environment, "restore", archive)
    assert code == 0, said
    assert "begin anew" in said
    code, said = isodyn(there.environment, "restore", archive)
    assert code == 2
    assert "not empty" in said
    there.start()
    for job in (first, waiting):
        assert there.wait_for(job)["status"] == "successful"
    assert there.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
