"""A window in, a position out, over HTTP: every frame, every status, every refusal."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event


@pytest.fixture(scope="module")
def window(true_field_uT: Callable[..., np.ndarray]) -> Callable[..., tuple[dict[str, Any], np.ndarray, float]]:
    """A window walked straight through the true field: (JSON window, true last position, true heading)."""

    def make(frame: str = "level", n: int = 24, seed: int = 0) -> tuple[dict[str, Any], np.ndarray, float]:
        rng = np.random.default_rng(seed)
        heading = 0.6
        along = np.linspace(0, 6.0, n)
        p = np.array([2.0, 1.5]) + along[:, None] * [np.cos(heading), np.sin(heading)]
        B = true_field_uT(p[:, 0], p[:, 1]) + rng.normal(0, 0.3, (n, 3))
        c, s = np.cos(heading), np.sin(heading)
        to_level = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        body: dict[str, Any] = {"frame": frame, "noise_ut": 0.3}
        walked = np.column_stack([p - p[0], np.zeros(n)])
        if frame in ("building", "body"):
            body |= {"b_ut": B.tolist(), "displacement_m": walked.tolist()}
        else:
            body |= {"b_ut": (B @ to_level.T).tolist(), "displacement_m": (walked @ to_level.T).tolist()}
        if frame == "norm":
            body["b_ut"] = np.linalg.norm(B, axis=1).tolist()
        if frame == "body":
            half = rng.uniform(-1, 1, n)  # the phone turns about the vertical in the hand
            body["orientation"] = [[np.cos(h), 0.0, 0.0, np.sin(h)] for h in half]
            turned = [
                np.array([[np.cos(2 * h), np.sin(2 * h), 0], [-np.sin(2 * h), np.cos(2 * h), 0], [0, 0, 1]]) @ b
                for h, b in zip(half, B, strict=True)
            ]
            body["b_ut"] = np.array(turned).tolist()
        return body, p[-1], heading

    return make


@pytest.mark.parametrize("frame", ["level", "building", "body", "norm"])
def test_a_window_in_every_frame_is_located(
    service: Any, mapped_floor: str, window: Callable[..., Any], frame: str
) -> None:
    body, truth, heading = window(frame)
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body})
    assert answer.status_code == 200, answer.text
    fix = answer.json()
    assert fix["status"] in ("fix", "ambiguous"), fix
    assert set(fix["estimates"]) == {"ml", "mlr", "abl"}
    ml = fix["estimates"]["ml"]
    assert ml["available"]
    assert ml["floor_id"] == mapped_floor
    assert np.hypot(*(np.array(ml["position_m"][:2]) - truth)) < 0.5, (ml, truth)
    assert ml["position_m"][2] == pytest.approx(1.2, abs=0.01)
    if frame == "level":
        assert ml["heading_rad"] == pytest.approx(heading, abs=0.1)
        assert fix["status"] == "fix"
    posterior = fix["posterior"]
    assert sum(posterior["floor_probability"].values()) == pytest.approx(1.0, abs=1e-6)
    assert 0 < posterior["radius_68_m"] <= posterior["radius_95_m"]
    assert np.linalg.eigvalsh(posterior["covariance_m2"]).min() > 0
    assert fix["map_ids"]
    assert fix["timing_ms"]["total"] >= fix["timing_ms"]["search"] > 0


def test_the_building_is_searched_and_techniques_are_chosen(
    service: Any, building: str, mapped_floor: str, window: Callable[..., Any]
) -> None:
    body, truth, _ = window()
    request = {"window": body, "techniques": ["mlr"], "composition": "demeaned"}
    answer = service.http.post(f"/v1/buildings/{building}/locate", json=request)
    assert answer.status_code == 200, answer.text
    fix = answer.json()
    assert set(fix["estimates"]) == {"mlr"}
    assert fix["posterior"]["floor_probability"][mapped_floor] > 0.5
    assert np.hypot(*(np.array(fix["posterior"]["position_m"][:2]) - truth)) < 1.0


def test_a_prior_is_believed(service: Any, mapped_floor: str, window: Callable[..., Any]) -> None:
    body, truth, _ = window()
    prior = {"position_m": [*truth.tolist(), 1.2], "sd_m": 0.5}
    fix = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body, "prior": prior}).json()
    assert np.hypot(*(np.array(fix["posterior"]["position_m"][:2]) - truth)) < 0.5


def test_a_field_that_is_nowhere_here_is_not_a_fix(service: Any, mapped_floor: str, window: Callable[..., Any]) -> None:
    body, _, _ = window()
    body["b_ut"] = (np.array(body["b_ut"]) + np.array([40.0, -35.0, 60.0])).tolist()
    fix = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body}).json()
    assert fix["status"] in ("inconsistent", "unmapped"), fix
    assert fix["reason"]


def test_a_floor_without_a_map_says_unmapped(
    service: Any, new_floor: Callable[..., str], window: Callable[..., Any]
) -> None:
    answer = service.http.post(f"/v1/floors/{new_floor()}/locate", json={"window": window()[0]})
    assert answer.status_code == 200, answer.text
    fix = answer.json()
    assert fix["status"] == "unmapped"
    assert fix["posterior"] is None
    assert not fix["estimates"]["ml"]["available"]
    assert fix["estimates"]["ml"]["reason"]


def test_a_batch_gives_the_same_fixes(service: Any, mapped_floor: str, window: Callable[..., Any]) -> None:
    queries = [{"window": window(seed=seed)[0]} for seed in (1, 2)]
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate:batch", json={"queries": queries})
    assert answer.status_code == 200, answer.text
    for query, fix in zip(queries, answer.json()["fixes"], strict=True):
        single = service.http.post(f"/v1/floors/{mapped_floor}/locate", json=query).json()
        assert fix["estimates"] == single["estimates"]
        assert fix["posterior"] == single["posterior"]


def test_a_window_of_one_sample_is_answered_and_an_empty_one_refused(
    service: Any, mapped_floor: str, window: Callable[..., Any]
) -> None:
    body, _, _ = window()
    one = {**body, "b_ut": body["b_ut"][:1], "displacement_m": [[0, 0, 0]]}
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": one})
    assert answer.status_code == 200, answer.text
    assert answer.json()["status"] != "fix", "one sample cannot tell where it is"
    empty = {**body, "b_ut": [], "displacement_m": []}
    assert service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": empty}).status_code == 422


BAD_WINDOWS: dict[str, dict[str, Any]] = {
    "lengths differ": {"displacement_m": [[0, 0, 0]]},
    "flat list in a vector frame": {"b_ut": [50.0] * 24},
    "no orientation": {"frame": "body"},
    "zero quaternion": {"frame": "body", "orientation": [[0, 0, 0, 0]] * 24},
    "no noise": {"noise_ut": 0},
    "misspelt": {"headingrad": 1.0},
    "time going backwards": {"t_s": [0.0, 1.0, 0.5, *range(2, 23)]},
    "how sure, but not of what": {"heading_sd_rad": 0.1},
    "negative magnitudes": {"frame": "norm", "b_ut": [-50.0] * 24},
    "huge": {"b_ut": [[1e300, 0, 0]] * 24},
}


@pytest.mark.parametrize("name", BAD_WINDOWS)
def test_a_bad_window_is_refused_with_where_and_why(
    service: Any, mapped_floor: str, window: Callable[..., Any], name: str
) -> None:
    body = {**window()[0], **BAD_WINDOWS[name]}
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body})
    assert answer.status_code == 422, answer.text
    assert answer.json()["errors"][0]["location"].startswith("/body")


def test_a_window_in_the_wrong_unit_says_which_unit_it_looks_like(
    service: Any, mapped_floor: str, window: Callable[..., Any]
) -> None:
    body = window()[0]
    body["b_ut"] = (1000 * np.array(body["b_ut"])).tolist()
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body})
    assert answer.status_code == 422
    assert "nanotesla" in answer.text
    assert answer.json()["errors"][0]["location"] == "/body/window/b_ut/0"


@pytest.mark.parametrize("composition", ["differenced", "feature"])
def test_what_the_contract_names_and_is_not_there_yet_says_so(
    service: Any, mapped_floor: str, window: Callable[..., Any], composition: str
) -> None:
    body = {"window": window()[0], "composition": composition}
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json=body)
    assert answer.status_code == 422
    assert "not offered yet" in answer.json()["detail"]


def test_json_without_its_content_type_says_so(service: Any, mapped_floor: str) -> None:
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", content=b"{}", headers={"Content-Type": "text/x"})
    assert answer.status_code == 422
    assert "Content-Type: application/json" in answer.text


@pytest.mark.parametrize("word", ["NaN", "Infinity", "1e999"])
def test_numbers_that_are_not_are_refused(service: Any, mapped_floor: str, word: str) -> None:
    text = '{"window": {"frame": "norm", "b_ut": [' + word + '], "displacement_m": [[0, 0, 0]]}}'
    headers = {"Content-Type": "application/json"}
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", content=text, headers=headers)
    assert answer.status_code == 422, answer.text


def test_a_huge_body_is_refused_before_it_is_parsed(service: Any, mapped_floor: str) -> None:
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", content=b" " * (2**20 + 1))
    assert answer.status_code == 413
    assert answer.json()["type"].endswith("/too-large")


def test_a_norm_map_answers_norm_windows_only(
    service: Any, walk_csv: Callable[..., bytes], window: Callable[..., Any]
) -> None:
    tower = service.http.post("/v1/buildings", json={"name": "Tower"}).json()["id"]
    body = {"name": "G", "ordinal": 0}
    floor = service.http.post(f"/v1/buildings/{tower}/floors", json=body).json()["id"]
    service.http.post(f"/v1/floors/{floor}/surveys", params={"frame": "norm"}, content=walk_csv(1))
    service.run_jobs()
    assert service.http.post(f"/v1/floors/{floor}/locate", json={"window": window("norm")[0]}).status_code == 200
    refused = service.http.post(f"/v1/floors/{floor}/locate", json={"window": window("level")[0]})
    assert refused.status_code == 422
    assert refused.json()["type"].endswith("/incompatible-frames")


def test_locate_takes_two_statements(
    service: Any, building: str, mapped_floor: str, window: Callable[..., Any], key_with: Callable[..., dict[str, str]]
) -> None:
    """One recognises the key, one finds the active maps of every candidate floor; a moment later the key is known."""
    body, fresh = {"window": window()[0]}, key_with("locate")
    statements: list[str] = []

    def note(*arguments: Any) -> None:
        statements.append(arguments[2])

    event.listen(service.context.engine, "before_cursor_execute", note)
    try:
        for _ in range(2):
            answer = service.http.post(f"/v1/buildings/{building}/locate", json=body, headers=fresh)
            assert answer.status_code == 200
    finally:
        event.remove(service.context.engine, "before_cursor_execute", note)
    assert len(statements) == 3, statements
