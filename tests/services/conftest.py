"""A small building of walks as a phone records them, whose field and places are known."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

STEP_S, STEP_M = 0.56, 0.64


def field_uT(p, floor):
    x, y = p[:, 0], p[:, 1]
    return np.stack(
        [
            3 + 8 * np.sin(x / 3 + floor) + 2 * np.cos(y / 2),
            26 + 7 * np.cos(x / 2.3 - 2 * floor),
            -41 + 9 * np.sin(x / 2.7 + 3 * floor) + 2 * np.sin(y / 2),
        ],
        axis=1,
    )


def trace(floor: int, seed: int) -> bytes:
    """A walk of about 27 m along a corridor and back into it, as a phone records it."""
    rng = np.random.default_rng([floor, seed])
    heading = np.pi * (seed % 2)
    start = np.array([1.0 if heading == 0 else 28.0, 4.0 + rng.uniform(-0.4, 0.4)])
    t_s = np.arange(0.0, 42 * STEP_S, 0.02)
    walked = STEP_M / STEP_S * t_s
    p = start + walked[:, None] * [np.cos(heading), np.sin(heading)]
    attitude = Rotation.from_euler("z", heading - np.pi / 2) * Rotation.from_euler("x", 0.3)
    force = 9.81 + 0.5 * (STEP_M / 0.41) ** 4 * np.cos(2 * np.pi * t_s / STEP_S)
    force_body = attitude.inv().apply(force[:, None] * [0.0, 0.0, 1.0])
    B_body = attitude.inv().apply(field_uT(p, floor)) + 0.3 * rng.standard_normal((len(p), 3))
    dragged = Rotation.from_euler("z", 0.05 * rng.standard_normal()) * attitude
    rotation_vector = dragged.as_quat(canonical=True)[:3]
    bias = [-20.0, 9.5, -317.25]
    lines = []
    for k in range(len(t_s)):
        stamp = 1_574_129_692_000 + round(1e3 * t_s[k])
        if k % 200 == 0 or k == len(t_s) - 1:
            lines.append(f"{stamp}\tTYPE_WAYPOINT\t{p[k, 0]:.3f}\t{p[k, 1]:.3f}")
        for kind, values in (
            ("ACCELEROMETER", force_body[k]),
            ("GYROSCOPE", (0.0, 0.0, 0.0)),
            ("ROTATION_VECTOR", rotation_vector),
            ("MAGNETIC_FIELD_UNCALIBRATED", (*(B_body[k] + bias), *bias)),
        ):
            lines.append(f"{stamp}\tTYPE_{kind}\t" + "\t".join(f"{v:.6g}" for v in values) + "\t3")
    return "\n".join([*lines, ""]).encode()


@pytest.fixture(scope="session")
def building(tmp_path_factory) -> Path:
    """Two floors of six walks, some packed, beside things that are no walks."""
    folder = tmp_path_factory.mktemp("building")
    for floor in (0, 1):
        (folder / f"F{floor}").mkdir()
        for seed in range(6):
            data = trace(floor, seed)
            name = f"F{floor}/walk-{seed}.txt"
            if seed % 2:
                (folder / f"{name}.gz").write_bytes(gzip.compress(data))
            else:
                (folder / name).write_bytes(data)
        (folder / f"F{floor}" / "floor_info.json").write_text("{}")
    (folder / "F0" / "broken.txt").write_bytes(b"nothing")
    (folder / "F0" / "cut.txt.gz").write_bytes(gzip.compress(data)[:500])
    (folder / "F9").mkdir()
    (folder / "README.md").write_text("not a floor")
    return folder
