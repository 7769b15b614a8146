"""Floors changed, outlined, and made from an indoor map."""

import json
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from app.db.tables import Floor
from app.errors import Conflict
from app.services.receive_survey import parse_survey, record_survey

NewFloor = Callable[..., str]
SQUARE = [[0.0, 0.0], [10.0, 0.0], [10.0, 10.0], [0.0, 10.0], [0.0, 0.0]]
POLYGON = {"type": "Polygon", "coordinates": [SQUARE]}
PARTS = {"type": "MultiPolygon", "coordinates": [[SQUARE], [[[x + 20, y] for x, y in SQUARE]]]}
ANCHOR = {"latitude_deg": 48.14, "longitude_deg": 11.56, "height_m": 520.0, "bearing_deg": 90.0}


def on_earth(lon: float = 11.56, lat: float = 48.14) -> dict[str, Any]:
    corners = [(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)]
    return {"type": "Polygon", "coordinates": [[[lon + 1e-3 * x, lat + 1e-3 * y] for x, y in corners]]}


def level(ordinal: int, geometry: dict[str, Any] = POLYGON, name: str = "Level") -> dict[str, Any]:
    properties = {"ordinal": ordinal, "name": {"en": f"{name} {ordinal}"}, "category": "unspecified"}
    return {"type": "Feature", "feature_type": "level", "id": "x", "properties": properties, "geometry": geometry}


def levels(*features: dict[str, Any]) -> dict[str, Any]:
    return {"type": "FeatureCollection", "features": list(features)}


@pytest.fixture
def house(service: Any) -> str:
    """A building of the test's own, with an anchor."""
    return str(service.http.post("/v1/buildings", json={"name": "Anchored", "anchor": ANCHOR}).json()["id"])


def add_floor(service: Any, building: str, ordinal: int, **more: Any) -> str:
    body = {"name": f"Floor {ordinal}", "ordinal": ordinal, **more}
    return str(service.http.post(f"/v1/buildings/{building}/floors", json=body).json()["id"])


def floors_of(service: Any, building: str) -> list[dict[str, Any]]:
    items: list[dict[str, Any]] = service.http.get(f"/v1/buildings/{building}/floors").json()["items"]
    return items


def test_a_building_is_changed_by_what_is_given(service: Any, house: str) -> None:
    url = f"/v1/buildings/{house}"
    before = service.http.get(url).json()
    assert service.http.patch(url, json={}).json() == before
    assert service.http.patch(url, json={"name": "New"}).json() == before | {"name": "New"}
    assert service.http.patch(url, json={"anchor": None}).json() == before | {"name": "New", "anchor": None}
    assert service.http.patch(url, json={"anchor": ANCHOR}).json()["anchor"] == ANCHOR
    for body in ({"name": None}, {"name": ""}, {"colour": "red"}, {"anchor": {"latitude_deg": 1}}):
        assert service.http.patch(url, json=body).status_code == 422, body


def test_a_floor_is_changed_by_what_is_given(service: Any, new_floor: NewFloor) -> None:
    floor = new_floor(outline=POLYGON, height_m=3.0)
    url = f"/v1/floors/{floor}"
    before = service.http.get(url).json()
    assert before["outline"] == POLYGON
    changes = {"name": "Mezzanine", "ordinal": 1, "height_m": 2.5, "auto_build": False, "outline": PARTS,
               "elevation_m": 2.0}  # fmt: skip
    assert service.http.patch(url, json=changes).json() == before | changes
    assert service.http.patch(url, json={"outline": None, "height_m": None}).json()["outline"] is None
    assert service.http.get(url).json() == before | changes | {"outline": None, "height_m": None}
    for name in ("name", "ordinal", "auto_build", "elevation_m"):
        answer = service.http.patch(url, json={name: None})
        assert (answer.status_code, answer.json()["errors"][0]["location"]) == (422, f"/body/{name}")
    for body in ({"active_map_id": "x"}, {"height_m": -1}, {"ordinal": 0.5}, {"plan": None}):
        assert service.http.patch(url, json=body).status_code == 422, body


def test_an_elevation_stays_once_there_are_surveys(
    service: Any, new_floor: NewFloor, walk_csv: Callable[..., bytes]
) -> None:
    floor = new_floor(elevation_m=4.0, auto_build=False)
    url = f"/v1/floors/{floor}"
    survey = service.http.post(f"{url}/surveys", content=walk_csv(1)).json()["survey"]["id"]
    refused = service.http.patch(url, json={"elevation_m": 5.0, "name": "Moved"})
    assert refused.status_code == 409
    assert "surveys at the elevation 4 m" in refused.json()["detail"]
    assert service.http.get(url).json()["name"] == "Ground"
    assert service.http.patch(url, json={"elevation_m": 4.0}).status_code == 200, "as it was"
    job = service.http.post(f"{url}/maps", json={}).json()["job"]["id"]
    service.http.delete(f"/v1/jobs/{job}")
    service.http.delete(f"/v1/surveys/{survey}")
    assert "maps at the elevation" in service.http.patch(url, json={"elevation_m": 5.0}).json()["detail"]


def test_a_survey_read_at_another_elevation_is_not_recorded(
    service: Any, new_floor: NewFloor, walk_csv: Callable[..., bytes]
) -> None:
    """The floor moves between the two steps of an upload."""
    floor = new_floor(elevation_m=4.0)
    parsed = parse_survey(
        service.context.blobs, walk_csv(9), format="csv", frame="building", name="w", elevation_m=4.0
    )  # fmt: skip
    with service.context.transaction() as session:
        row = session.get_one(Floor, floor)
        assert service.http.patch(f"/v1/floors/{floor}", json={"elevation_m": 5.0}).status_code == 200
        with pytest.raises(Conflict, match="send it again"):
            record_survey(session, service.context.queue, row, parsed)
    assert service.http.get(f"/v1/floors/{floor}/surveys").json()["items"] == []


def test_an_outline_comes_as_any_geojson(service: Any, new_floor: NewFloor) -> None:
    floor = new_floor()
    url = f"/v1/floors/{floor}/outline"
    feature = {"type": "Feature", "properties": {"x": 1}, "geometry": PARTS}
    for body, outline in ((POLYGON, POLYGON), (feature, PARTS), (levels(level(1, PARTS), level(0)), POLYGON)):
        for kind in ("application/json", "application/geo+json"):
            answer = service.http.put(url, content=json.dumps(body), headers={"Content-Type": kind})
            assert answer.status_code == 200, answer.text
            assert answer.json()["outline"] == outline
            assert service.http.get(f"/v1/floors/{floor}").json() == answer.json()


@pytest.mark.parametrize(
    ("body", "where"),
    [
        (b'{"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, NaN], [0, 0]]]}', "/body/coordinates/0/2/1"),
        (b'{"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 9]]]}', "/body/coordinates/0"),
        (b'{"type": "Polygon", "coordinates": [[[0, 0], [9e4, 0], [9, 9], [0, 0]]]}', "/body"),
        (b'{"type": "\\ud800"}', "/body/type"),
        (b'{"type": "FeatureCollection", "features": []}', "/body/features"),
        (b"[1, 2]", "/body"),
        (b'{"type": ' + b"[" * 900 + b"]" * 900 + b"}", "/body/type"),
    ],
)
def test_an_outline_that_cannot_be_used_says_where(service: Any, new_floor: NewFloor, body: bytes, where: str) -> None:
    floor = new_floor(outline=POLYGON)
    headers = {"Content-Type": "application/geo+json"}
    answer = service.http.put(f"/v1/floors/{floor}/outline", content=body, headers=headers)
    assert answer.status_code == 422, answer.text
    assert answer.json()["errors"][0]["location"] == where
    patched = service.http.patch(f"/v1/floors/{floor}", content=b'{"outline": ' + body + b"}")
    assert patched.status_code == 422
    made = b'{"name": "x", "ordinal": 0, "outline": ' + body + b"}"
    building = service.http.get(f"/v1/floors/{floor}").json()["building_id"]
    assert service.http.post(f"/v1/buildings/{building}/floors", content=made).status_code == 422
    assert service.http.get(f"/v1/floors/{floor}").json()["outline"] == POLYGON


def test_longitudes_and_latitudes_take_an_anchor(service: Any, house: str) -> None:
    floor = add_floor(service, house, 0)
    url, asked = f"/v1/floors/{floor}/outline", {"params": {"coordinates": "wgs84"}}
    outline = service.http.put(url, json=on_earth(), **asked).json()["outline"]
    np.testing.assert_allclose(outline["coordinates"][0][2], [74.40, 111.21], atol=0.03)
    swapped = service.http.put(url, json=on_earth(48.14, 11.56), **asked)
    assert swapped.status_code == 422
    assert "[longitude, latitude]" in swapped.json()["detail"]
    assert "coordinates=wgs84" in service.http.put(url, json=on_earth(0, 0)).json()["detail"], "degrees sent as metres"
    service.http.patch(f"/v1/buildings/{house}", json={"anchor": None})
    refused = service.http.put(url, json=on_earth(), **asked)
    assert refused.status_code == 409
    assert "has no anchor" in refused.json()["detail"]
    assert service.http.get(f"/v1/floors/{floor}").json()["outline"] == outline, "already in metres"


def imported(service: Any, building: str, body: Any, **asked: Any) -> Any:
    return service.http.post(f"/v1/buildings/{building}/floors:import", json=body, params=asked)


def test_an_indoor_map_makes_and_outlines_floors(service: Any, house: str) -> None:
    ground = add_floor(service, house, 0, elevation_m=0.5)
    kept = add_floor(service, house, 7, outline=POLYGON)
    venue = levels(level(2, on_earth()), level(0, on_earth()), level(-1, on_earth(), name="Basement"))
    answer = imported(service, house, venue, coordinates="wgs84", storey_height_m=3.5)
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert [(f["name"], f["ordinal"], f["elevation_m"]) for f in told["made"]] == [
        ("Basement -1", -1, -3.5), ("Level 2", 2, 7.0),
    ]  # fmt: skip
    (changed,) = told["changed"]
    assert (changed["id"], changed["name"], changed["elevation_m"]) == (ground, "Floor 0", 0.5)
    assert told["unchanged"] == []
    there = {floor["id"]: floor for floor in floors_of(service, house)}
    assert len(there) == 4
    assert all(there[floor["id"]] == floor for floor in told["made"] + told["changed"])
    assert there[kept]["outline"] == POLYGON
    again = imported(service, house, venue, coordinates="wgs84").json()
    assert (again["made"], again["changed"], len(again["unchanged"])) == ([], [], 3)


def test_an_import_is_all_or_nothing(service: Any, house: str) -> None:
    add_floor(service, house, 0)
    broken = {"type": "Polygon", "coordinates": [SQUARE[:-1]]}
    before = floors_of(service, house)
    answer = imported(service, house, levels(level(0), level(1), level(2, broken)))
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["location"] == "/body/features/2/geometry/coordinates/0"
    assert imported(service, house, POLYGON).status_code == 422
    assert imported(service, house, levels()).status_code == 422
    twin = add_floor(service, house, 1), add_floor(service, house, 1)
    before = floors_of(service, house)
    refused = imported(service, house, levels(level(0), level(1), level(2)))
    assert refused.status_code == 409
    assert all(each in refused.json()["detail"] for each in twin)
    assert floors_of(service, house) == before
    assert imported(service, house, levels(level(0), level(2))).status_code == 200, "of other ordinals: no matter"


def test_imports_at_once_make_every_floor_once(service: Any, house: str) -> None:
    answers: list[int] = []
    body = levels(*(level(k) for k in range(5)))

    def run() -> None:
        answers.append(imported(service, house, body).status_code)

    threads = [threading.Thread(target=run) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answers == [200] * 4
    assert [floor["ordinal"] for floor in floors_of(service, house)] == list(range(5))


def test_a_repeated_import_is_answered_once(service: Any, house: str) -> None:
    url, headers = f"/v1/buildings/{house}/floors:import", {"Idempotency-Key": f"import-{house}"}
    first, again = (service.http.post(url, json=levels(level(0)), headers=headers) for _ in range(2))
    assert first.json() == again.json()
    assert len(again.json()["made"]) == 1
    assert service.http.post(url, json=levels(level(1)), headers=headers).status_code == 409


def test_another_outline_is_another_page(service: Any, mapped_floor: str, active_map: str) -> None:
    url = f"/v1/maps/{active_map}/view.html"
    before = service.http.get(url).headers["etag"]
    service.http.patch(f"/v1/floors/{mapped_floor}", json={"outline": PARTS})
    answer = service.http.get(url, headers={"If-None-Match": before})
    assert answer.status_code == 200
    assert answer.headers["etag"] != before
    assert service.http.patch(f"/v1/floors/{mapped_floor}", json={"outline": None}).status_code == 200
