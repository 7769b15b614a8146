"""What a map says of positioning before anybody asks: gradients, expected errors, best and worst points."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest


def path_of(map_id: str) -> str:
    return f"/v1/maps/{map_id}/localizability"


def test_best_and_worst_points_carry_the_gradient_that_the_field_has_there(service: Any, active_map: str) -> None:
    answer = service.http.get(path_of(active_map))
    assert answer.status_code == 200, answer.text
    told = answer.json()
    points = [told["best"]["position_m"], told["worst"]["position_m"]]
    field = service.http.post(f"/v1/maps/{active_map}/field", json={"points_m": points, "gradient": True}).json()
    for point, gradient in zip((told["best"], told["worst"]), field["gradient_ut_per_m"], strict=True):
        along = np.array(gradient, dtype=float)[:, :2]
        assert point["gradient_ut_per_m"] == pytest.approx(np.sqrt(np.sum(along**2)), rel=1e-4)
    total = told["gradient_ut_per_m"]["total"]
    assert told["worst"]["gradient_ut_per_m"] < total["p5"] < total["p50"] < total["p95"]
    assert total["p95"] < told["best"]["gradient_ut_per_m"]
    assert told["height_m"] == pytest.approx(1.2)
    assert told["components"] == ["bx", "by", "bz"]


def test_better_sensors_and_longer_windows_do_better(service: Any, active_map: str) -> None:
    def median(**asked: object) -> float:
        told = service.http.get(path_of(active_map), params={"window_m": 4, **asked}).json()
        assert 0.0 < told["judged_share"] <= 1.0
        assert told["share_within_1_m"] <= told["share_within_5_m"] <= told["judged_share"]
        return float(told["expected_error_m"]["p50"])

    usual = median()
    assert 0.02 < usual < 1.0
    assert median(noise_ut=3) > 1.5 * usual
    assert median(bias="unknown") > usual
    assert median(heading="known") < usual
    assert median(window_m=2) > usual


def test_an_answer_is_kept_for_ever_under_the_question(service: Any, active_map: str) -> None:
    first = service.http.get(path_of(active_map))
    assert "immutable" in first.headers["cache-control"]
    assert service.http.get(f"/v1/maps/{active_map}").json()["sha256"] in first.headers["etag"]
    known = {"If-None-Match": first.headers["etag"]}
    assert service.http.get(path_of(active_map), headers=known).status_code == 304
    other = service.http.get(path_of(active_map), params={"window_m": 5}, headers=known)
    assert other.status_code == 200
    assert other.headers["etag"] != first.headers["etag"]


@pytest.mark.parametrize(
    "asked", [{"window_m": 0}, {"window_m": 51}, {"noise_ut": -1}, {"noise_ut": "nan"}, {"bias": "perhaps"}]
)
def test_questions_out_of_range_are_refused(service: Any, active_map: str, asked: dict[str, object]) -> None:
    assert service.http.get(path_of(active_map), params=asked).status_code == 422


def test_a_window_longer_than_the_floor_is_judged_by_nothing(service: Any, active_map: str) -> None:
    told = service.http.get(path_of(active_map), params={"window_m": 50}).json()
    assert told["expected_error_m"] is None
    assert told["best"]["expected_error_m"] is None
    assert (told["judged_share"], told["share_within_5_m"]) == (0.0, 0.0)


def test_it_takes_a_finished_map_of_ones_own(
    service: Any, active_map: str, new_floor: Callable[..., str], stranger: dict[str, str], mapped_floor: str
) -> None:
    assert service.http.get(path_of(active_map), headers=stranger).status_code == 404
    assert service.http.get(path_of("nope")).status_code == 404
    asked = service.http.post(f"/v1/floors/{mapped_floor}/maps", json={"activate": False})
    assert service.http.get(path_of(asked.json()["map"]["id"])).status_code == 409
    service.run_jobs()


def picture(service: Any, map_id: str, layer: str, **asked: object) -> Any:
    return service.http.get(f"/v1/maps/{map_id}/heatmap.png", params={"layer": layer, **asked})


def test_the_picture_is_of_the_window_and_sensor_that_were_stated(service: Any, active_map: str) -> None:
    shown = [
        picture(service, active_map, "expected_error", **asked)
        for asked in ({}, {"window_m": 3}, {"noise_ut": 3}, {"bias": "unknown"}, {"heading": "known"})
    ]
    assert {answer.status_code for answer in shown} == {200}
    assert len({answer.headers["etag"] for answer in shown}) == len({answer.content for answer in shown}) == 5
    same = picture(service, active_map, "expected_error", window_m=10, noise_ut=0.5, bias="known", heading="unknown")
    assert (same.headers["etag"], same.content) == (shown[0].headers["etag"], shown[0].content)
    better, worse = (picture(service, active_map, "information", noise_ut=noise) for noise in (0.5, 3))
    assert better.headers["etag"] != worse.headers["etag"]
    assert better.content != worse.content


@pytest.mark.parametrize(
    ("layer", "asked"),
    [("norm", {"window_m": 10}), ("information", {"bias": "known"}), ("sd", {"noise_ut": 1, "heading": "known"})],
)
def test_a_parameter_of_another_layer_is_refused(
    service: Any, active_map: str, layer: str, asked: dict[str, object]
) -> None:
    answer = picture(service, active_map, layer, **asked)
    assert answer.status_code == 422
    assert {each["location"] for each in answer.json()["errors"]} == {f"/query/{name}" for name in asked}
    assert f"does not belong to the layer {layer}" in answer.json()["detail"]
    assert picture(service, active_map, "expected_error", window_m=51).status_code == 422


@pytest.mark.parametrize("layer", ["gradient_x", "gradient_y", "information", "expected_error"])
def test_the_layers_are_pictures(service: Any, active_map: str, layer: str) -> None:
    answer = service.http.get(f"/v1/maps/{active_map}/heatmap.png", params={"layer": layer})
    assert answer.status_code == 200, answer.text
    assert answer.content.startswith(b"\x89PNG")
