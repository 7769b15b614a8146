"""A new map of a floor that is searched is in memory before somebody asks for it."""

from collections.abc import Callable
from typing import Any

import pytest

from app.services.keep_warm import keep_warm

BODY: dict[str, Any] = {
    "window": {
        "frame": "level", "noise_ut": 0.5, "b_ut": [[19.8, 2.1, -43.0], [19.1, 2.6, -43.4], [18.2, 3.0, -44.1]],
        "displacement_m": [[0, 0, 0], [0.6, 0, 0], [1.2, 0, 0]],
    }
}  # fmt: skip


@pytest.fixture
def loaded(service: Any, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Hashes of the blobs that were read."""
    read: list[str] = []
    store = type(service.context.blobs)
    get = store.get

    def noting(self: Any, sha256: str) -> bytes:
        read.append(sha256)
        return bytes(get(self, sha256))

    monkeypatch.setattr(store, "get", noting)
    return read


def ask(service: Any, building: str) -> list[str]:
    answer = service.http.post(f"/v1/buildings/{building}/locate", json=BODY)
    assert answer.status_code == 200, answer.text
    return list(answer.json()["map_ids"])


def test_the_first_window_on_a_new_map_loads_nothing(
    service: Any, building: str, mapped_floor: str, active_map: str, walk_csv: Callable[..., bytes], loaded: list[str]
) -> None:
    assert ask(service, building) == [active_map]
    service.http.post(f"/v1/floors/{mapped_floor}/surveys", content=walk_csv(9, offset_m=0.1))
    service.run_jobs()
    published = service.http.get(f"/v1/floors/{mapped_floor}").json()["active_map_id"]
    assert published != active_map
    keep_warm(service.context.engine, service.context.grids)  # as the server itself does, perhaps by now
    loaded.clear()
    assert ask(service, building) == [published]
    assert loaded == []
    assert keep_warm(service.context.engine, service.context.grids) == 0, "nothing is new"

    service.context.grids._entries.clear()  # as if it had been dropped for others
    assert service.http.post(f"/v1/maps/{active_map}/activate").status_code == 200
    assert loaded, "made ready before it answers"
    loaded.clear()
    assert ask(service, building) == [active_map]
    assert loaded == []


def test_a_floor_that_nobody_searches_is_left_alone(service: Any, active_map: str, loaded: list[str]) -> None:
    service.context.grids._searched.clear()
    service.context.grids._entries.clear()
    assert service.http.post(f"/v1/maps/{active_map}/activate").status_code == 200
    assert keep_warm(service.context.engine, service.context.grids) == 0
    assert loaded == []
