"""Disturbed stretches of surveys over HTTP: told, excluded by hand or at one word, and taken in again."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

FROM_S, TO_S = 40.0, 46.0


@pytest.fixture(scope="module")
def disturbed_csv(walk_csv: Callable[..., bytes]) -> bytes:
    """A walk that a trolley passes: 25 uT more for six seconds, come and gone at once."""
    lines = walk_csv(4).decode().splitlines()
    rows = np.array([[float(v) for v in line.split(",")] for line in lines[1:]])
    rows[(rows[:, 0] >= FROM_S) & (rows[:, 0] <= TO_S), 4:] += [15.0, -10.0, 17.0]
    return "\n".join([lines[0], *(",".join(f"{v:.4f}" for v in row) for row in rows)]).encode()


def disturbances(service: Any, survey: str) -> Any:
    answer = service.http.get(f"/v1/surveys/{survey}/disturbances")
    assert answer.status_code == 200, answer.text
    return answer.json()


def field_at(service: Any, floor: str, point: list[float]) -> np.ndarray:
    active = service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    answer = service.http.post(f"/v1/maps/{active}/field", json={"points_m": [point]}).json()
    return np.array(answer["mean_ut"][0])


def test_a_trolley_is_told_excluded_and_taken_in_again(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes], disturbed_csv: bytes,
    true_field_uT: Callable[..., np.ndarray],
) -> None:  # fmt: skip
    floor = new_floor()
    path = f"/v1/floors/{floor}/surveys"
    clean = service.http.post(path, content=walk_csv(1)).json()["survey"]["id"]
    survey = service.http.post(path, content=disturbed_csv).json()["survey"]["id"]
    assert disturbances(service, clean)["stretches"] == []
    told = disturbances(service, survey)
    assert (told["map_id"], told["excluded_s"]) == (None, [])
    first = told["stretches"][0]
    assert first["start_s"] <= FROM_S + 0.5
    assert first["end_s"] >= TO_S - 0.5
    assert first["end_s"] - first["start_s"] < 12.0
    assert first["size_ut"] == pytest.approx(25.0, rel=0.3)
    assert "uT" in first["reason"]
    service.run_jobs()
    told = disturbances(service, survey)
    assert told["map_id"]
    assert disturbances(service, clean)["map_id"] == told["map_id"]
    middle = np.array([line.split(",") for line in disturbed_csv.decode().splitlines()[1:]], dtype=float)
    x, y = middle[np.argmin(np.abs(middle[:, 0] - 43.0)), 1:3]
    truth = true_field_uT(np.array([x]), np.array([y]))[0]
    wrong = np.linalg.norm(field_at(service, floor, [x, y, 1.2]) - truth)
    assert wrong > 3.0, "the trolley is on the map"

    answer = service.http.patch(f"/v1/surveys/{survey}", json={"exclude_disturbed": True})
    assert answer.status_code == 200, answer.text
    assert answer.json()["job"]["status"] == "accepted"
    (start, end), *_ = answer.json()["excluded_s"]
    assert start <= FROM_S + 0.5
    assert end >= TO_S - 0.5
    service.run_jobs()
    assert np.linalg.norm(field_at(service, floor, [x, y, 1.2]) - truth) < 1.0
    assert disturbances(service, survey)["excluded_s"] == answer.json()["excluded_s"]
    samples = service.http.get(f"/v1/surveys/{survey}/samples").json()["count"]
    assert samples == answer.json()["sample_count"], "the survey itself stays whole"

    again = service.http.patch(f"/v1/surveys/{survey}", json={"exclude_disturbed": True}).json()
    assert again["job"] is None, "nothing changed"
    back = service.http.patch(f"/v1/surveys/{survey}", json={"excluded_s": []}).json()
    assert back["excluded_s"] == []
    assert back["job"]["status"] == "accepted"
    service.run_jobs()
    assert np.linalg.norm(field_at(service, floor, [x, y, 1.2]) - truth) == pytest.approx(wrong, abs=0.05)


def test_stretches_by_hand(service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]) -> None:
    floor = new_floor(auto_build=False)
    survey = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1)).json()["survey"]["id"]
    path = f"/v1/surveys/{survey}"
    asked = {"excluded_s": [[30.0, 35.0], [10.0, 12.0], [34.0, 40.0]], "included": False}
    told = service.http.patch(path, json=asked).json()
    assert (told["excluded_s"], told["included"], told["job"]) == ([[10.0, 12.0], [30.0, 40.0]], False, None)
    for body, where in (
        ({}, ""), ({"excluded_s": [[3.0, 1.0]]}, "/body/excluded_s/0"), ({"excluded_s": [[1.0]]}, "excluded_s"),
        ({"exclude_disturbed": False}, "exclude_disturbed"), ({"included": None}, "included"),
    ):  # fmt: skip
        answer = service.http.patch(path, json=body)
        assert answer.status_code == 422, answer.text
        assert where in answer.text


def test_a_survey_of_which_nothing_is_left_is_left_out(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]
) -> None:
    floor = new_floor()
    first, second = (
        service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(seed)).json()["survey"]["id"]
        for seed in (1, 2)
    )
    service.http.patch(f"/v1/surveys/{second}", json={"excluded_s": [[-1.0, 1e6]]})
    service.run_jobs()
    active = service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    quality = service.http.get(f"/v1/maps/{active}/quality").json()
    assert set(quality["surveys"]) == {first}
    assert quality["excluded_s"] == {second: [[-1.0, 1e6]]}
