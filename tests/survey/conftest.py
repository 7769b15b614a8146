"""Surveys as bytes, and phone traces of walks that are known exactly."""

import json
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from scipy.spatial.transform import Rotation

HEADER = "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut"


@dataclass(frozen=True)
class KnownWalk:
    """A constructed walk: what the sensors recorded as a trace, and the truth at 50 Hz."""

    text: str
    t_s: np.ndarray
    p_m: np.ndarray
    yaw_rad: np.ndarray
    corners_m: np.ndarray
    bias_uT: np.ndarray

    @property
    def data(self) -> bytes:
        return self.text.encode()


def field_uT(p_m: np.ndarray) -> np.ndarray:
    """A smooth field in the building frame, (n, 3)."""
    x, y = p_m[:, 0], p_m[:, 1]
    return np.stack([2 + 4 * np.sin(x / 6), 28 + 5 * np.cos(y / 5), -40 + 4 * np.sin((x + y) / 7)], axis=1)


def make_walk(
    *,
    seed: int = 0,
    corners: tuple[tuple[float, float], ...] = ((0, 0), (14, 0), (14, 10), (2, 10)),
    wait_s: float = 3.0,
) -> KnownWalk:
    """A walk from corner to corner at uneven speed, standing still `wait_s` at every corner, phone tilted and noisy.

    Steps are one oscillation of the specific force each, with the amplitude Weinberg's rule asks for at that length.
    """
    rng = np.random.default_rng(seed)
    corners_m = np.array(corners, dtype=float)
    p, yaw, phase, amplitude, corner_s = _path(corners_m, wait_s)
    n = len(p)
    t_s = np.arange(n) / 50.0
    roll, pitch = 0.1 * np.sin(t_s / 3), 0.25 + 0.08 * np.cos(t_s / 4)
    # Level frame: x forward, y left; the phone's own axes: y forward, x right, z up.
    phone = Rotation.from_rotvec(np.multiply.outer(yaw - np.pi / 2, [0, 0, 1.0])) * Rotation.from_euler(
        "xy", np.stack([pitch, roll], axis=1)
    )
    rate = (phone[:-1].inv() * phone[1:]).as_rotvec() * 50.0
    rate = np.concatenate([rate[:1], rate])
    force = phone.inv().apply(np.stack([0 * t_s, 0 * t_s, 9.81 + amplitude * np.cos(phase)], axis=1))
    bias = np.array([-20.0, 9.5, -317.25])
    B_body = phone.inv().apply(field_uT(p)) + 0.3 * rng.standard_normal((n, 3))
    dragged = Rotation.from_rotvec(np.multiply.outer(0.1 * np.sin(t_s / 5), [0, 0, 1.0])) * phone
    rotation_vector = dragged.as_quat(canonical=True)[:, :3]
    lines = ["#\tstartTime:1574129692070", "#\tBrand:OPPO\tModel:PBCM10\tAndroidName:8.1.0\t"]
    stamp = (1_574_129_692_000 + np.round(t_s * 1e3)).astype(np.int64)
    taps = {round(s * 50): k for k, s in enumerate(corner_s)}
    for i in range(n):
        if i in taps:
            x, y = corners_m[taps[i]]
            lines.append(f"{stamp[i]}\tTYPE_WAYPOINT\t{x}\t{y}")
        for kind, values in (
            ("ACCELEROMETER", force[i]),
            ("MAGNETIC_FIELD", B_body[i]),
            ("GYROSCOPE", rate[i]),
            ("ROTATION_VECTOR", rotation_vector[i]),
            ("MAGNETIC_FIELD_UNCALIBRATED", (*(B_body[i] + bias), *bias)),
        ):
            lines.append(f"{stamp[i]}\tTYPE_{kind}\t" + "\t".join(f"{v:.7g}" for v in values) + "\t3")
    return KnownWalk("\n".join(lines) + "\n", t_s, p, yaw, corners_m, bias)


def _path(corners_m, wait_s):
    """Positions, yaw, step phase and amplitude at 50 Hz, and when each corner was reached."""
    p, yaw, phase, amplitude, corner_s = [corners_m[0]], [], [0.0], [], [0.0]
    legs = np.diff(corners_m, axis=0)
    headings = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    yaw.append(headings[0])
    amplitude.append(0.0)
    for k, leg in enumerate(legs):
        length = float(np.linalg.norm(leg))
        steps = round(length / 0.65)
        step_m = length / steps
        per_step = np.where(np.arange(steps) < steps // 2, 24, 32)  # the second half of each leg is slower
        for count in per_step:
            for _j in range(1, count + 1):
                p.append(p[-1] + leg / length * step_m / count)
                phase.append(phase[-1] + 2 * np.pi / count)
                amplitude.append(0.5 * (step_m / 0.41) ** 4)
                yaw.append(headings[k])
        corner_s.append((len(p) - 1) / 50.0)
        if k + 1 < len(legs):
            wait = int(wait_s * 50)
            turn = headings[k] + (headings[k + 1] - headings[k]) * np.linspace(0, 1, wait)
            p += [p[-1]] * wait
            phase += [phase[-1]] * wait
            amplitude += [0.0] * wait
            yaw += list(turn)
    return np.array(p), np.array(yaw), np.array(phase), np.array(amplitude), corner_s


@pytest.fixture(scope="session")
def known_walk() -> KnownWalk:
    return make_walk()


CANONICAL = ("t_s", "x_m", "y_m", "z_m", "bx_ut", "by_ut", "bz_ut")
ATTITUDE = ("qw", "qx", "qy", "qz")


@pytest.fixture
def table() -> dict[str, np.ndarray]:
    """A small survey with attitude, as columns."""
    rng = np.random.default_rng(1)
    n = 30
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    columns = [np.arange(n) / 10.0, *rng.uniform(0, 9, (3, n)), *rng.uniform(15, 35, (3, n)), *q.T]
    return dict(zip(CANONICAL + ATTITUDE, columns, strict=True))


def as_csv(columns) -> bytes:
    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(repr(float(x)) for x in row) for row in rows), ""]).encode()


def as_ndjson(columns) -> bytes:
    rows = zip(*columns.values(), strict=True)
    return "".join(json.dumps(dict(zip(columns, map(float, row), strict=True))) + "\n" for row in rows).encode()


def as_parquet(columns) -> bytes:
    sink = pa.BufferOutputStream()
    parquet.write_table(pa.table(dict(columns)), sink)
    return sink.getvalue().to_pybytes()


@pytest.fixture(params=["csv", "ndjson", "parquet"])
def written(request):
    """(format, function from columns to bytes) of each canonical format."""
    return request.param, {"csv": as_csv, "ndjson": as_ndjson, "parquet": as_parquet}[request.param]


@pytest.fixture
def writers():
    return {"csv": as_csv, "ndjson": as_ndjson, "parquet": as_parquet}


@pytest.fixture
def field():
    return field_uT


@pytest.fixture
def walk_maker():
    return make_walk
