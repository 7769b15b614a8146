"""The plan of a floor: put, shown, replaced, taken away."""

import io
from collections.abc import Callable
from hashlib import sha256
from typing import Any

import pytest
from PIL import Image

NewFloor = Callable[..., str]


def picture(size: tuple[int, int] = (60, 40), format: str = "PNG") -> bytes:
    out = io.BytesIO()
    Image.new("RGB", size, "white").save(out, format)
    return out.getvalue()


def put(service: Any, floor: str, data: bytes | None = None, **asked: object) -> Any:
    params = {"metres_per_pixel": 0.5} | asked
    return service.http.put(f"/v1/floors/{floor}/plan", params=params, content=picture() if data is None else data)


def test_a_plan_is_put_and_shown(service: Any, new_floor: NewFloor) -> None:
    floor = new_floor()
    assert service.http.get(f"/v1/floors/{floor}").json()["plan"] is None
    assert service.http.get(f"/v1/floors/{floor}/plan").status_code == 404
    answer = put(service, floor, x_m=-3.0, y_m=2.5, bearing_rad=0.1)
    assert answer.status_code == 200, answer.text
    plan = answer.json()["plan"]
    assert plan == {
        "sha256": plan["sha256"], "media_type": "image/png", "width_px": 60, "height_px": 40, "width_m": 30.0,
        "height_m": 20.0, "metres_per_pixel": 0.5, "x_m": -3.0, "y_m": 2.5, "bearing_rad": 0.1,
    }  # fmt: skip
    assert service.http.get(f"/v1/floors/{floor}").json() == answer.json()
    shown = service.http.get(f"/v1/floors/{floor}/plan")
    assert shown.headers["content-type"] == "image/png"
    assert shown.headers["etag"] == f'"{plan["sha256"]}"'
    assert shown.headers["x-content-type-options"] == "nosniff"
    assert "immutable" not in shown.headers["cache-control"]
    assert sha256(shown.content).hexdigest() == plan["sha256"]
    assert Image.open(io.BytesIO(shown.content)).size == (60, 40)
    again = service.http.get(f"/v1/floors/{floor}/plan", headers={"If-None-Match": shown.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_a_plan_is_replaced_and_taken_away(service: Any, new_floor: NewFloor) -> None:
    floor = new_floor()
    first = put(service, floor).json()["plan"]
    second = put(service, floor, picture((80, 20), "JPEG"), metres_per_pixel=0.1).json()["plan"]
    assert (second["media_type"], second["x_m"], second["width_m"]) == ("image/webp", 0.0, pytest.approx(8.0))
    shown = service.http.get(f"/v1/floors/{floor}/plan", headers={"If-None-Match": f'"{first["sha256"]}"'})
    assert (shown.status_code, shown.headers["content-type"]) == (200, "image/webp")
    for _ in range(2):
        assert service.http.delete(f"/v1/floors/{floor}/plan").status_code == 204
        assert service.http.get(f"/v1/floors/{floor}/plan").status_code == 404
        assert service.http.get(f"/v1/floors/{floor}").json()["plan"] is None


def test_a_plan_may_be_larger_than_a_json_body(service: Any, new_floor: NewFloor) -> None:
    noise = Image.effect_noise((1500, 1500), 100)
    out = io.BytesIO()
    noise.save(out, "PNG")
    assert len(out.getvalue()) > service.context.settings.max_body_bytes
    answer = put(service, new_floor(), out.getvalue())
    assert answer.status_code == 200, answer.text


@pytest.mark.parametrize(
    ("data", "status"),
    [
        (b"", 422), (b"a picture, I swear", 422), (b"<svg xmlns='http://www.w3.org/2000/svg'/>", 422),
        (picture()[:50], 422), (bytes(20 * 2**20 + 1), 413),
    ],
)  # fmt: skip
def test_a_refused_picture_leaves_nothing(service: Any, new_floor: NewFloor, data: bytes, status: int) -> None:
    floor = new_floor()
    put(service, floor)
    before = service.http.get(f"/v1/floors/{floor}").json(), service.row_counts(), service.blob_count()
    answer = put(service, floor, data)
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    if status == 422:
        assert answer.json()["errors"][0]["location"] == "/body"
    assert (service.http.get(f"/v1/floors/{floor}").json(), service.row_counts(), service.blob_count()) == before


@pytest.mark.parametrize(
    "asked",
    [
        {"metres_per_pixel": 0}, {"metres_per_pixel": -1}, {"metres_per_pixel": "nan"}, {"metres_per_pixel": "inf"},
        {"metres_per_pixel": None}, {"x_m": "nan"}, {"y_m": 1e9}, {"bearing_rad": 90}, {"bearing_rad": "inf"},
    ],
)  # fmt: skip
def test_a_placement_that_means_nothing_is_refused(service: Any, new_floor: NewFloor, asked: dict[str, Any]) -> None:
    answer = put(service, new_floor(), **asked)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["location"] == f"/query/{next(iter(asked))}"


def test_a_plan_needs_its_own_organisation_and_scope(
    service: Any, new_floor: NewFloor, stranger: dict[str, str], key_with: Callable[..., dict[str, str]]
) -> None:
    floor = new_floor()
    put(service, floor)
    url, asked = f"/v1/floors/{floor}/plan", {"params": {"metres_per_pixel": 1}, "content": picture()}
    blobs = service.blob_count()
    for headers, status in ((stranger, 404), (key_with("map:read"), 403), (key_with("survey:write"), 403)):
        assert service.http.put(url, headers=headers, **asked).status_code == status
        assert service.http.delete(url, headers=headers).status_code == status
    assert service.http.get(url, headers=stranger).status_code == 404
    assert service.http.get(url, headers=key_with("locate")).status_code == 403
    assert service.http.get(url, headers=key_with("map:read")).status_code == 200
    assert service.blob_count() == blobs
