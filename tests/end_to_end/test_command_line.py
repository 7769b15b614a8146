"""The commands that speak to a server, against a real one: a device is calibrated, and its walk uploaded."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

HARD_IRON_UT = np.array([25.0, -12.0, 30.0])
FIELD_UT = np.array([18.0, 3.0, -42.0])


def isodyn(server: Any, *arguments: object) -> tuple[int, str]:
    """Exit code and all output of a command."""
    speaking = {"ISODYN_URL": str(server.http.base_url), "ISODYN_KEY": "isd_end-to-end", "COLUMNS": "200"}
    ended = subprocess.run(
        [sys.executable, "-m", "app.cli", *map(str, arguments)],
        env={**os.environ, **speaking}, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return ended.returncode, ended.stdout + ended.stderr


def test_a_device_is_calibrated_and_its_walk_uploaded(server: Any, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(1000, 3))
    turned = np.linalg.norm(FIELD_UT) * directions / np.linalg.norm(directions, axis=1, keepdims=True) + HARD_IRON_UT
    np.savetxt(
        tmp_path / "turned.csv", np.column_stack([np.arange(1000), turned + rng.normal(0, 0.05, turned.shape)]),
        delimiter=",", header="t_s,bx_ut,by_ut,bz_ut", comments="",
    )  # fmt: skip
    magnitude = f"{np.linalg.norm(FIELD_UT):.4f}"
    code, said = isodyn(server, "calibrate", "phone", tmp_path / "turned.csv", "--magnitude-ut", magnitude)
    assert code == 0, said
    assert "phone version 1, by two_step: 1,000 readings" in said
    assert "24 of 24 parts of the sphere" in said
    # a quarter of them: refused, with what rotation is missing
    half = (tmp_path / "turned.csv").read_text().splitlines()
    few = [half[0], *(line for line in half[1:] if float(line.split(",")[1]) > 58.0)]
    (tmp_path / "few.csv").write_text("\n".join(few))
    code, said = isodyn(server, "calibrate", "phone", tmp_path / "few.csv", "--magnitude-ut", magnitude)
    assert code == 1
    assert "were not seen" in said
    code, said = isodyn(server, "calibrate", "phone", __file__)
    assert code == 2
    assert "bx_ut,by_ut,bz_ut" in said

    x = np.arange(0.0, 20.0, 0.1)
    walk = np.column_stack([
        x, x, np.zeros_like(x), np.full_like(x, 1.2), FIELD_UT + HARD_IRON_UT + rng.normal(0, 0.1, (len(x), 3)),
        np.tile([1.0, 0.0, 0.0, 0.0], (len(x), 1)),
    ])  # fmt: skip
    header = "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut,qw,qx,qy,qz"
    np.savetxt(tmp_path / "walk.csv", walk, delimiter=",", header=header, comments="")
    floor = server.new_floor()
    code, said = isodyn(server, "ingest", floor, tmp_path / "walk.csv", "--device", "phone", "--no-wait")
    assert code == 0, said
    (survey,) = server.http.get(f"/v1/floors/{floor}/surveys").json()["items"]
    assert survey["session"] == "phone v1"
    rows = np.array(server.http.get(f"/v1/surveys/{survey['id']}/samples").json()["rows"])
    np.testing.assert_allclose(rows[:, 4:].mean(axis=0), FIELD_UT, atol=0.3)
