"""What `/metrics` says: bounded, of nobody, well named, and only to those who may ask."""

import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from app.api.context import Context

LABELS = {
    "method", "route", "status", "type", "reason", "technique", "available", "outcome", "result", "operation", "kind",
    "step", "state", "le", "version", "python", "generation", "implementation", "major", "minor", "patchlevel",
}  # fmt: skip
WINDOW = {"frame": "building", "b_ut": [[19.8, 2.1, -43.0], [18.0, 3.0, -42.0]],
          "displacement_m": [[0, 0, 0], [0.5, 0, 0]], "noise_ut": 0.5}  # fmt: skip


@pytest.fixture
def metrics_key(service: Any, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    context: Context = service.context
    monkeypatch.setattr(context.settings, "metrics_key", "isd_metrics-of-this-test")
    return {"Authorization": "Bearer isd_metrics-of-this-test"}


def series(service: Any) -> set[tuple[str, tuple[tuple[str, str], ...]]]:
    text = service.http.get("/metrics").text
    families = text_string_to_metric_families(text)
    return {(sample.name, tuple(sorted(sample.labels.items()))) for family in families for sample in family.samples}


def traffic(service: Any, headers: dict[str, str], walk: bytes, name: str) -> Iterator[str]:
    """One building, its floor, and one of everything; the ids and names that were used."""
    http = service.http
    building = http.post("/v1/buildings", json={"name": name}, headers=headers).json()["id"]
    floor = http.post(
        f"/v1/buildings/{building}/floors", json={"name": name, "ordinal": 0, "elevation_m": 0.0}, headers=headers
    ).json()["id"]
    yield from (building, floor, name)
    for _ in range(2):
        upload = http.post(f"/v1/floors/{floor}/surveys?name={name}", content=walk, headers=headers)
        assert upload.status_code in (200, 202), upload.text
        yield upload.json()["survey"]["id"]
    http.post(f"/v1/floors/{floor}/surveys", content=b"no,survey\n", headers=headers)
    located = http.post(f"/v1/buildings/{building}/locate", json={"window": WINDOW}, headers=headers)
    assert located.status_code == 200, located.text
    track = http.post("/v1/tracks", json={"building_id": building, "frame": "level"}, headers=headers)
    http.get(f"/v1/floors/{floor}/{name}", headers=headers)
    http.get(f"/v1/maps/{name}", headers={"Authorization": f"Bearer {name}"})
    http.request("BREW", f"/v1/floors/{floor}", headers=headers)
    if track.status_code == 201:
        yield track.json()["id"]


def test_series_do_not_grow_with_what_is_stored(
    service: Any, walk_csv: Callable[..., bytes], stranger: dict[str, str]
) -> None:
    known = [*traffic(service, {}, walk_csv(1), "first-name")]
    series(service)  # itself a request
    before = series(service)
    for k in range(3):
        known += [*traffic(service, {}, walk_csv(k + 2), f"another-name-{k}")]
        known += [*traffic(service, stranger, walk_csv(k + 2), f"strange-name-{k}")]
    grown = series(service) - before
    assert not {name for name, _ in grown if not name.startswith("isodyn_http")}, grown
    assert len(grown) < 60, grown  # routes and statuses that were not met before
    told = service.http.get("/metrics").text
    assert not [word for word in known if word in told]
    assert not re.search(r"[0-9a-f]{8}-[0-9a-f]{4}-", told)
    assert {label for _, labels in before for label, _ in labels} <= LABELS


def test_prometheus_finds_nothing_to_mend(service: Any) -> None:
    if shutil.which("promtool") is None:
        pytest.skip("no promtool: apt-get install prometheus")
    told = service.http.get("/metrics").content
    run = subprocess.run(["promtool", "check", "metrics"], input=told, capture_output=True, check=False)
    assert (run.returncode, run.stdout, run.stderr) == (0, b"", b"")


def test_the_metrics_key_opens_metrics_and_nothing_else(service: Any, metrics_key: dict[str, str]) -> None:
    assert service.http.get("/metrics", headers=metrics_key).status_code == 200
    assert service.http.get("/v1/buildings", headers=metrics_key).status_code == 401
    assert service.http.get("/metrics", headers={"Authorization": "Bearer isd_another"}).status_code == 401
