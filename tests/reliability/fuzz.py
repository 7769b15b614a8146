"""Requests nobody would send, many thousand of them, to a real server: no 5xx, nothing outside the contract, no growth.

`python -m tests.reliability.fuzz` runs 50,000 generated from the OpenAPI document (schemathesis) and 10,000 of surveys
and windows (hypothesis): files and windows that are almost right, which generators of JSON never reach. A shorter run
is a test.
"""

import argparse
import gzip
import io
import json
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import hypothesis
import numpy as np
import pyarrow as pa
import pyarrow.parquet
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from app.synthetic.hall import hall_uT
from tests.api.test_contract import check_contract
from tests.reliability.campaign import walk_csv
from tests.reliability.installation import KEY, installation

__all__ = ["fuzz_contract", "fuzz_inputs"]

COLUMNS = ("t_s", "x_m", "y_m", "z_m", "bx_ut", "by_ut", "bz_ut", "qw", "qx", "qy", "qz")
ODD = (0.0, -0.0, 1e-320, 1e308, -1e308, float("nan"), float("inf"), 1999.9, 2000.1, 2.0**53, 5e-324)
ODD_WORDS = ("", " ", "nan", "-inf", "1e999", "0x10", "١", "1,5", "\x00", '"', "'; --", "1_000", "null", "—", "1e-400")
MOST_GROWTH_MIB = 200.0

numbers = st.one_of(st.floats(-100, 100), st.sampled_from(ODD), st.floats(), st.integers(-(2**70), 2**70))


@st.composite
def tables(draw: st.DrawFn) -> dict[str, list[Any]]:
    """A table of samples that is almost, or quite, in order."""
    count = draw(st.integers(0, 40))
    names = list(draw(st.sampled_from([COLUMNS[:7], COLUMNS, COLUMNS[:4], COLUMNS[1:7]])))
    rng = np.random.default_rng(draw(st.integers(0, 9)))
    made: dict[str, list[Any]] = {name: (20.0 + rng.normal(0, 5, count)).tolist() for name in names}
    if "t_s" in made:
        made["t_s"] = (0.1 * np.arange(count)).tolist()
    for _ in range(draw(st.integers(0, 3))):
        name = draw(st.sampled_from(names))
        if count:
            made[name][draw(st.integers(0, count - 1))] = draw(numbers)
    if draw(st.booleans()) and count:
        made[draw(st.sampled_from(names))].pop()  # a column shorter than the others
    return made


@st.composite
def csv_files(draw: st.DrawFn) -> bytes:
    """A file of commas: a table with words in odd places, or a walk with bytes changed."""
    if draw(st.booleans()):
        data = bytearray(walk_csv(0, draw(st.integers(0, 300))))
        for _ in range(draw(st.integers(0, 3))):
            data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
        return bytes(data[: draw(st.integers(0, len(data)))] if draw(st.booleans()) else data)
    made = draw(tables())
    lines = [[str(v) for v in row] for row in zip(*made.values(), strict=False)]
    for _ in range(draw(st.integers(0, 3))):
        if lines:
            row = draw(st.sampled_from(lines))
            row[draw(st.integers(0, len(row) - 1))] = draw(st.sampled_from(ODD_WORDS))
    separator, end = draw(st.sampled_from([",", ";", "\t", ", "])), draw(st.sampled_from(["\n", "\r\n", "\r"]))
    text = end.join([separator.join(made), *(separator.join(line) for line in lines)])
    return text.encode(draw(st.sampled_from(["utf-8", "utf-8-sig", "utf-16"])))


@st.composite
def ndjson_files(draw: st.DrawFn) -> bytes:
    made = draw(tables())
    lines = [json.dumps(dict(zip(made, row, strict=True))) for row in zip(*made.values(), strict=False)]
    lines += draw(st.lists(st.sampled_from(["{", "[]", "null", '{"t_s": {}}', "{" * 3000, '"', "1"]), max_size=2))
    return "\n".join(draw(st.permutations(lines)) if len(lines) < 8 else lines).encode()


@st.composite
def parquet_files(draw: st.DrawFn) -> bytes:
    made = draw(tables())
    least = min((len(values) for values in made.values()), default=0)
    kinds = draw(st.sampled_from([pa.float64(), pa.float32(), pa.string(), pa.int64(), pa.list_(pa.float64())]))
    columns: dict[str, Any] = {}
    for name, values in made.items():
        kept = [float(v) for v in values[:least]]
        if kinds == pa.string():
            columns[name] = pa.array([str(v) for v in kept])
        elif kinds == pa.int64():
            columns[name] = pa.array([int(v) if abs(v) < 2**60 else None for v in kept])
        elif kinds == pa.float64() or kinds == pa.float32():
            columns[name] = pa.array(kept, kinds)
        else:
            columns[name] = pa.array([[v] for v in kept], kinds)
    file = io.BytesIO()
    pyarrow.parquet.write_table(pa.table(columns), file, compression=draw(st.sampled_from(["none", "zstd", "gzip"])))
    data = bytearray(file.getvalue())
    for _ in range(draw(st.integers(0, 4))):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    return bytes(data)


@st.composite
def traces(draw: st.DrawFn) -> bytes:
    """An Android trace of few lines, some of them wrong."""
    kinds = ("TYPE_WAYPOINT", "TYPE_MAGNETIC_FIELD", "TYPE_MAGNETIC_FIELD_UNCALIBRATED", "TYPE_ACCELEROMETER",
             "TYPE_GYROSCOPE", "TYPE_ROTATION_VECTOR", "TYPE_WIFI", "TYPE_NONSENSE")  # fmt: skip
    lines = ["#\tstartTime:1571723300000"]
    t = 1571723300000
    for _ in range(draw(st.integers(0, 40))):
        t += draw(st.sampled_from([20, 20, 20, 0, -5, 10**9]))
        values = draw(st.lists(st.one_of(st.floats(-60, 60).map(str), st.sampled_from(ODD_WORDS)), max_size=7))
        lines.append("\t".join([str(t), draw(st.sampled_from(kinds)), *values]))
    return "\n".join(lines).encode("utf-8", "surrogatepass")


FILES: dict[str, SearchStrategy[bytes]] = {
    "csv": csv_files(), "ndjson": ndjson_files(), "parquet": parquet_files(), "indoor-location-2020": traces(),
}  # fmt: skip


@st.composite
def surveys(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    if draw(st.integers(0, 5)) == 0:  # quite right
        return "surveys", {"content": walk_csv(0, draw(st.integers(0, 300))), "params": {"format": "csv"}}
    format = draw(st.sampled_from(sorted(FILES)))
    data = draw(st.one_of(FILES[format], draw(st.sampled_from(list(FILES.values()))), st.binary(max_size=300)))
    headers = {}
    if draw(st.integers(0, 4)) == 0:
        data = gzip.compress(data) if draw(st.booleans()) else data
        headers = {"Content-Encoding": draw(st.sampled_from(["gzip", "zstd", "br", "gzip, gzip"]))}
    query = {"format": format, "frame": draw(st.sampled_from(["building", "level", "norm"]))}
    return "surveys", {"content": data, "headers": headers, "params": query}


@st.composite
def windows(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    """A window as a client sends it, with at most two things wrong."""
    frame = draw(st.sampled_from(["building", "level", "norm", "body"]))
    count = draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    walked = np.column_stack([np.linspace(0, draw(st.sampled_from([0.0, 0.5, 5.0])), count), np.zeros((count, 2))])
    B = hall_uT(3.0 + walked[:, 0], np.full(count, 4.0)) + rng.normal(0, draw(st.sampled_from([0.4, 30.0])), (count, 3))
    window: dict[str, Any] = {
        "frame": frame,
        "b_ut": (np.linalg.norm(B, axis=1) if frame == "norm" else B).tolist(),
        "displacement_m": walked.tolist(),
        "noise_ut": 0.5,
    }
    if frame == "body":
        window["orientation"] = [[1.0, 0.0, 0.0, 0.0]] * count
    if draw(st.booleans()):
        window["t_s"] = (0.1 * np.arange(count)).tolist()
    body: dict[str, Any] = {"window": window}
    if draw(st.booleans()):
        body["composition"] = draw(st.sampled_from(["raw", "demeaned", "differenced", "feature"]))
    if draw(st.booleans()):
        body["prior"] = {"position_m": [4.0, 4.0, 1.2], "sd_m": draw(st.sampled_from([5.0, 0.01, 1e6]))}
    for _ in range(draw(st.integers(0, 2))):
        _spoil(draw, body if draw(st.integers(0, 3)) == 0 else window)
    return "locate", {"content": json.dumps(body), "headers": {"Content-Type": "application/json"},
                      "params": {"explain": draw(st.booleans())}}  # fmt: skip


def _spoil(draw: st.DrawFn, object_: dict[str, Any]) -> None:
    """Put something odd somewhere."""
    odd = st.one_of(numbers, st.sampled_from([None, "1", [], {}, True, [[]], "nan"]))
    name = draw(st.sampled_from([*object_, "heading_rad", "heading_sd_rad", "bias_sd_ut", "nonsense"]))
    values = object_.get(name)
    if isinstance(values, list) and values and draw(st.integers(0, 3)):
        k = draw(st.integers(0, len(values) - 1))
        if isinstance(values[k], list) and draw(st.booleans()):
            values[k] = [*values[k][:-1], draw(odd)]
        else:
            values[k] = draw(odd)
    else:
        object_[name] = draw(odd)


def fuzz_inputs(http: httpx.Client, floor: str, cases: int, seed: int = 0) -> Counter[str]:
    """Send so many surveys and windows. Returns statuses by kind. Raises AssertionError for what should never be."""
    statuses: Counter[str] = Counter()

    @hypothesis.seed(seed)
    @settings(max_examples=cases, deadline=None, database=None, phases=[Phase.generate],
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(asked=st.one_of(surveys(), windows()))
    def holds(asked: tuple[str, dict[str, Any]]) -> None:
        what, arguments = asked
        answer = http.post(f"/v1/floors/{floor}/{what}", **arguments)
        statuses[f"{what} {answer.status_code}"] += 1
        assert answer.status_code in (200, 202, 400, 409, 413, 422), (answer.status_code, answer.text[:500])
        if answer.is_error:
            problem = answer.json()
            assert answer.headers["content-type"] == "application/problem+json"
            assert problem["status"] == answer.status_code
            assert problem["detail"]

    holds()
    return statuses


def fuzz_contract(address: str, calls: int) -> Counter[str]:
    """Send at least so many requests made from the server's own description. Returns calls by operation."""
    schema = schemathesis.openapi.from_url(f"{address}/openapi.json")
    operations = sum(1 for _ in schema.get_all_operations())
    made: Counter[str] = Counter()
    while sum(made.values()) < calls:
        left = calls - sum(made.values())
        made.update(check_contract(schema, KEY, examples=max(5, left // (2 * operations)), seed=sum(made.values())))
    return made


def rss_mib(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.reliability.fuzz", description=__doc__.split("\n")[0])
    parser.add_argument("--contract", type=int, default=50_000, help="requests by schemathesis")
    parser.add_argument("--inputs", type=int, default=10_000, help="surveys and windows by hypothesis")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, installation("sqlite", Path(folder), 0.0) as site:
        site.start(apis=1, workers=1)
        (address,), (api,) = site.addresses, site.apis
        with httpx.Client(base_url=address, headers={"Authorization": f"Bearer {KEY}"}, timeout=120) as http:
            floor = mapped_floor(http)
            fuzz_inputs(http, floor, max(arguments.inputs // 10, 100))
            before = rss_mib(api.pid)
            start = time.monotonic()
            statuses = fuzz_inputs(http, floor, arguments.inputs, seed=1)
            told = ", ".join(f"{count} {status}" for status, count in sorted(statuses.items()))
            after = rss_mib(api.pid)
            print(f"{sum(statuses.values())} surveys and windows in {time.monotonic() - start:.0f} s: {told}")
            print(f"  memory of the server {before:.0f} MiB, then {after:.0f}", flush=True)
            start = time.monotonic()
            calls = fuzz_contract(address, arguments.contract)
            last = rss_mib(api.pid)
            print(f"{sum(calls.values())} requests of {len(calls)} operations in {time.monotonic() - start:.0f} s")
            print(f"  memory of the server then {last:.0f} MiB; no 5xx, no answer outside the contract")
        assert api.restarts == 0, site.logs()[-3000:]
        assert last < before + MOST_GROWTH_MIB, "memory grew"
    sys.exit(0)


def mapped_floor(http: httpx.Client) -> str:
    """A floor with a map, which no further survey changes."""
    building = http.post("/v1/buildings", json={"name": "House"}).json()["id"]
    body = {"name": "G", "ordinal": 0, "elevation_m": 0.0, "auto_build": False}
    floor = str(http.post(f"/v1/buildings/{building}/floors", json=body).json()["id"])
    for number in range(3):
        http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(0, number)).raise_for_status()
    job = http.post(f"/v1/floors/{floor}/maps", json={}).json()["job"]["id"]
    while http.get(f"/v1/jobs/{job}").json()["status"] in ("accepted", "running"):
        time.sleep(0.2)
    return floor


if __name__ == "__main__":
    main()
