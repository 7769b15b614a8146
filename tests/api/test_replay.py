"""A walk replayed over HTTP: a line a window, beside the truth; what is refused is refused before the first line."""

import asyncio
import gzip
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

HEADER = "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut"
ELEVATION_M = 7.5
Walk = Callable[..., bytes]


@pytest.fixture(scope="module")
def held_out(true_field_uT: Callable[..., np.ndarray]) -> Walk:
    """A walk aslant over the lanes of the map, then back along its edge."""

    def make(norm: bool = False, spacing_m: float = 0.1) -> bytes:
        corners = np.array([[1.0, 1.0], [10.5, 6.5], [10.5, 2.0], [2.0, 5.5]])
        legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(legs)])
        s = np.arange(0.0, along[-1], spacing_m)
        x, y = (np.interp(s, along, corners[:, axis]) for axis in (0, 1))
        B = true_field_uT(x, y) + np.random.default_rng(5).normal(0, 0.3, (len(s), 3))
        if norm:
            B = np.linalg.norm(B, axis=1, keepdims=True)
        rows = np.column_stack([s, x, y, np.full(len(s), 1.2), B])
        header = HEADER if not norm else "t_s,x_m,y_m,z_m,b_ut"
        return "\n".join([header, *(",".join(f"{v:.4f}" for v in row) for row in rows)]).encode()

    return make


def replay(service: Any, floor: str, data: bytes, headers: dict[str, str] | None = None, **asked: Any) -> Any:
    return service.http.post(f"/v1/floors/{floor}/replay", params=asked, content=data, headers=headers)


def lines_of(answer: Any) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/x-ndjson"
    path, *windows = [json.loads(line) for line in answer.text.splitlines()]
    assert (path["kind"], {each["kind"] for each in windows}) == ("path", {"window"})
    assert path["windows"] == len(windows)
    return path, windows


@pytest.mark.parametrize("frame", ["building", "level", "norm"])
def test_a_walk_is_answered_window_by_window_beside_where_it_was(
    service: Any, mapped_floor: str, held_out: Walk, frame: str
) -> None:
    before = service.row_counts(), service.blob_count()
    answer = replay(service, mapped_floor, held_out(frame == "norm"), frame=frame, window_m=8, every_m=2)
    path, windows = lines_of(answer)
    assert path["floor_id"] == mapped_floor
    assert (path["path_m"][0], path["path_m"][-1]) == ([1.0, 1.0, 1.2], pytest.approx([2.0, 5.5, 1.2], abs=0.1))
    assert len(windows) in (9, 10)
    assert np.median([each["error_m"] for each in windows]) < 0.5
    assert np.mean([each["error_m"] <= each["radius_95_m"] for each in windows]) >= 0.8
    for each in windows:
        off_m = np.hypot(*(np.array(each["position_m"]) - each["truth_m"])[:2])
        assert each["error_m"] == pytest.approx(off_m)
        assert 0.0 < each["probability"] <= 1.0
        assert np.linalg.eigvalsh(each["covariance_m2"]).min() > 0.0
    times = [each["t_s"] for each in windows]
    assert times == sorted(times)
    assert (service.row_counts(), service.blob_count()) == before, "nothing is stored"


def test_a_packed_file_is_replayed_as_it_is(service: Any, mapped_floor: str, held_out: Walk) -> None:
    data = held_out()
    plain = replay(service, mapped_floor, data, every_m=8)
    packed = replay(service, mapped_floor, gzip.compress(data), {"Content-Encoding": "gzip"}, every_m=8)
    assert lines_of(packed) == lines_of(plain)
    damaged = replay(service, mapped_floor, data, {"Content-Encoding": "gzip"})
    assert damaged.status_code == 422


def norm_floor(service: Any, new_floor: Callable[..., str], walk_csv: Walk) -> str:
    floor = new_floor(elevation_m=ELEVATION_M, auto_build=False)
    for seed in (1, 2):
        service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(seed, offset_m=0.3 * seed))
    answer = service.http.post(f"/v1/floors/{floor}/maps", json={"components": "norm"})
    assert answer.status_code == 202, answer.text
    service.run_jobs()
    return floor


def trace(true_field_uT: Callable[..., np.ndarray]) -> bytes:
    """A phone carried level and straight along y = 3, one step of 0.64 m each 0.56 s."""
    lines = []
    for k, t in enumerate(np.arange(0.0, 9.0, 0.02)):
        x = 1.0 + 0.64 / 0.56 * t
        bx, by, bz = true_field_uT(np.array([x]), np.array([3.0]))[0]
        stamp = 1_574_129_692_000 + round(1e3 * t)
        if k in (0, 449):
            lines.append(f"{stamp}\tTYPE_WAYPOINT\t{x:.3f}\t3.0")
        force = 9.81 + 0.5 * (0.64 / 0.41) ** 4 * np.cos(2 * np.pi * t / 0.56)
        for kind, values in (
            ("ACCELEROMETER", (0.0, 0.0, force)),
            ("GYROSCOPE", (0.0, 0.0, 0.0)),
            ("ROTATION_VECTOR", (0.0, 0.0, -np.sin(np.pi / 4))),  # its top edge points along x
            ("MAGNETIC_FIELD_UNCALIBRATED", (-by, bx, bz, 0.0, 0.0, 0.0)),
        ):
            lines.append(f"{stamp}\tTYPE_{kind}\t" + "\t".join(f"{v:.6g}" for v in values) + "\t3")
    return "\n".join([*lines, ""]).encode()


def test_a_map_of_magnitudes_is_asked_for_magnitudes_and_traces_stand_on_their_floor(
    service: Any, new_floor: Callable[..., str], walk_csv: Walk, held_out: Walk, true_field_uT: Any
) -> None:
    floor = norm_floor(service, new_floor, walk_csv)
    _, windows = lines_of(replay(service, floor, held_out(), every_m=4))
    assert np.median([each["error_m"] for each in windows]) < 1.0
    path, windows = lines_of(replay(service, floor, trace(true_field_uT), format="indoor-location-2020", window_m=5))
    heights_m = {each[2] for each in path["path_m"]} | {each["truth_m"][2] for each in windows}
    assert heights_m == {ELEVATION_M + 1.2}


def standing(x_m: list[float]) -> bytes:
    return "\n".join([HEADER, *(f"{k},{x},3,1.2,18,2,-43" for k, x in enumerate(x_m))]).encode()


REFUSED = {
    "empty": (b"", {}, "unreadable-survey"),
    "one sample": (standing([1.0]), {}, "unreadable-survey"),
    "not a number": (standing([1.0, float("nan"), 3.0]), {}, "unreadable-survey"),
    "standing still": (standing([1.0] * 50), {}, "invalid-input"),
    "two near samples": (standing([1.0, 2.0]), {}, "invalid-input"),
    "shorter than a window": (standing([0.1 * k for k in range(90)]), {}, "invalid-input"),
    "a table, not a trace": (standing([1.0, 2.0]), {"format": "indoor-location-2020"}, "unreadable-survey"),
    "no window": (standing([1.0, 2.0]), {"window_m": 0}, "invalid-input"),
    "not finite": (standing([1.0, 2.0]), {"every_m": "nan"}, "invalid-input"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_walk_that_cannot_be_replayed_is_refused_with_where_and_why(
    service: Any, mapped_floor: str, name: str
) -> None:
    data, asked, kind = REFUSED[name]
    answer = replay(service, mapped_floor, data, **asked)
    assert (answer.status_code, answer.headers["content-type"]) == (422, "application/problem+json"), answer.text
    assert answer.json()["type"].endswith(kind)
    assert answer.json()["errors"]


def test_who_may_not_and_what_is_not_there(
    service: Any,
    mapped_floor: str,
    new_floor: Callable[..., str],
    held_out: Walk,
    stranger: dict[str, str],
    key_with: Callable[..., dict[str, str]],
) -> None:
    data = held_out()
    assert replay(service, mapped_floor, data, stranger).status_code == 404
    assert replay(service, mapped_floor, data, key_with("survey:write", "map:read")).status_code == 403
    assert replay(service, mapped_floor, data, key_with("locate"), every_m=10).status_code == 200
    bare = replay(service, new_floor(), data)
    assert (bare.status_code, bare.json()["type"].rsplit("/", 1)[-1]) == (409, "conflict")
    large = replay(service, mapped_floor, b" " * (2**21 + 1))
    assert large.status_code == 413
    assert replay(service, mapped_floor, data + b"\n" * 2**20, every_m=10).status_code == 200, "larger than a JSON body"


def test_a_client_that_goes_away_ends_the_work(service: Any, mapped_floor: str, held_out: Walk) -> None:
    """The application as a server calls it: the client leaves after the third line."""
    data, lines, gone = held_out(), [], asyncio.Event()
    scope = {
        "type": "http", "asgi": {"version": "3.0", "spec_version": "2.3"}, "http_version": "1.1", "method": "POST",
        "scheme": "http", "path": f"/v1/floors/{mapped_floor}/replay", "root_path": "", "query_string": b"every_m=0.2",
        "headers": [(b"authorization", service.http.headers["authorization"].encode())], "state": {},
    }  # fmt: skip
    bodies = [{"type": "http.request", "body": data, "more_body": False}]

    async def receive() -> dict[str, Any]:
        if bodies:
            return bodies.pop()
        await gone.wait()
        return {"type": "http.disconnect"}

    async def send(message: dict[str, Any]) -> None:
        lines.extend(message.get("body", b"").splitlines())
        if len(lines) >= 3:
            gone.set()

    asyncio.run(service.app(scope, receive, send))
    told = len(lines)
    assert json.loads(lines[0])["windows"] > 50
    assert 3 <= told < 6
    time.sleep(0.3)
    assert len(lines) == told
    assert service.context.searches.submit(lambda: "free").result(timeout=10) == "free"
