"""A window in, a position out, over HTTP: every frame, every status, every refusal."""

import base64
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


@pytest.mark.parametrize("composition", ["demeaned", "differenced", "feature"])
def test_every_composition_is_answered(
    service: Any, mapped_floor: str, window: Callable[..., Any], composition: str
) -> None:
    body = {"window": window()[0], "composition": composition, "techniques": ["ml", "mlr", "abl", "mad", "contour"]}
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json=body)
    assert answer.status_code == 200, answer.text
    fix, truth = answer.json(), window()[1]
    assert set(fix["estimates"]) == {"ml", "mlr", "abl", "mad", "contour"}
    if composition != "feature":
        assert np.hypot(*(np.array(fix["estimates"]["ml"]["position_m"][:2]) - truth)) < 0.7, fix
        assert np.hypot(*(np.array(fix["estimates"]["mad"]["position_m"][:2]) - truth)) < 1.0, fix
    for estimate in fix["estimates"].values():
        assert estimate["available"] or estimate["reason"]


def test_a_window_without_a_feature_says_so(service: Any, mapped_floor: str, window: Callable[..., Any]) -> None:
    body = window()[0]
    body["b_ut"] = [body["b_ut"][0]] * len(body["b_ut"])
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body, "composition": "feature"})
    assert answer.status_code == 422
    assert "stands out" in answer.json()["errors"][0]["reason"]


def test_an_explanation_shows_the_likelihood_and_the_residuals(
    service: Any, mapped_floor: str, window: Callable[..., Any]
) -> None:
    body, truth, _ = window()
    plain = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body}).json()
    assert "explanation" not in plain
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate?explain=true", json={"window": body})
    assert answer.status_code == 200, answer.text
    told = answer.json()["explanation"]
    assert base64.b64decode(told["likelihood"]["png"]).startswith(b"\x89PNG")
    surface = np.array(told["likelihood"]["log_likelihood"], dtype=float)
    row, column = np.unravel_index(np.nanargmax(surface), surface.shape)
    peak = np.array(told["likelihood"]["origin_m"]) + told["likelihood"]["resolution_m"] * np.array([column, row])
    assert np.hypot(*(peak - truth)) < 1.0
    best = told["best"]
    assert len(best["path_m"]) == len(best["residual_ut"]) == len(best["residual_sds"])
    assert 0.3 < np.sqrt(np.mean(np.square(best["residual_sds"]))) < 1.5
    assert abs(best["step_scale"] - 1.0) < 0.1


def test_what_is_known_of_the_window_can_be_told(service: Any, mapped_floor: str, window: Callable[..., Any]) -> None:
    body, truth, _ = window()
    x, y = truth
    ring = [[x - 2, y - 2], [x + 2, y - 2], [x + 2, y + 2], [x - 2, y + 2], [x - 2, y - 2]]
    options = {
        "bias_sd_ut": 2.0, "step_scale_sd": 0.02, "heading_drift_sd_rad_per_m": 0.0, "time_budget_ms": 60_000,
        "walkable": {"type": "Polygon", "coordinates": [ring]},
    }  # fmt: skip
    fix = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body, "options": options}).json()
    assert fix["status"] == "fix", fix
    assert np.hypot(*(np.array(fix["estimates"]["ml"]["position_m"][:2]) - truth)) < 0.5
    elsewhere = {"walkable": {"type": "MultiPolygon", "coordinates": [[[[900, 0], [901, 0], [901, 1], [900, 0]]]]}}
    refused = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body, "options": elsewhere})
    assert refused.status_code == 422
    assert "walkable" in refused.json()["detail"]
    flat = {"walkable": {"type": "Polygon", "coordinates": [[[0, 0], [1, 1]]]}}
    assert (
        service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body, "options": flat}).status_code
        == 422
    )


def test_a_window_indexed_by_time_needs_a_speed(service: Any, mapped_floor: str, window: Callable[..., Any]) -> None:
    body, truth, heading = window()
    distance = np.linalg.norm(body.pop("displacement_m"), axis=1)
    without = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": body})
    assert without.status_code == 422
    assert "speed_m_s" in without.text
    timed = body | {"t_s": (distance / 1.2).tolist(), "speed_m_s": 1.1, "heading_rad": heading, "heading_sd_rad": 0.1}
    fix = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": timed}).json()
    assert np.hypot(*(np.array(fix["estimates"]["ml"]["position_m"][:2]) - truth)) < 0.7, fix


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
        if "organisation_id" in arguments[2]:  # not what keeps maps warm
            statements.append(arguments[2])

    event.listen(service.context.engine, "before_cursor_execute", note)
    try:
        for _ in range(2):
            answer = service.http.post(f"/v1/buildings/{building}/locate", json=body, headers=fresh)
            assert answer.status_code == 200
    finally:
        event.remove(service.context.engine, "before_cursor_execute", note)
    assert len(statements) == 3, statements
