"""Maps over HTTP: parameters, the field at points, files, pictures, activation."""

import io
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.io import netcdf_file

from app.db.tables import Map
from app.services.artefacts import layers_from_bytes, layers_to_bytes


def test_the_field_at_points_is_the_true_field_and_never_invented(
    service: Any, active_map: str, true_field_uT: Callable[..., np.ndarray]
) -> None:
    points = [[2.0, 2.0, 1.2], [6.3, 4.1, 9.9], [500.0, 0.0, 1.2], [-40.0, -40.0, 0.0]]
    answer = service.http.post(f"/v1/maps/{active_map}/field", json={"points_m": points, "gradient": True}).json()
    assert answer["measured"] == [True, True, False, False]
    assert answer["components"] == ["bx", "by", "bz"]
    assert answer["mean_ut"][2:] == [None, None]
    assert answer["gradient_ut_per_m"][2] is None
    assert answer["points_m"] == points
    truth = true_field_uT(np.array([2.0, 6.3]), np.array([2.0, 4.1]))
    np.testing.assert_allclose(answer["mean_ut"][:2], truth, atol=1.0)
    step = 1e-3
    dx = (true_field_uT(np.array([2.0 + step]), np.array([2.0])) - truth[0]) / step
    np.testing.assert_allclose(np.array(answer["gradient_ut_per_m"][0], dtype=float)[:, 0], dx[0], atol=1.5)
    assert answer["gradient_ut_per_m"][0][0][2] is None


@pytest.mark.parametrize("format", ["netcdf", "npz", "csv", "covjson"])
def test_every_export_carries_the_same_field_and_a_strong_etag(service: Any, active_map: str, format: str) -> None:
    answer = service.http.get(f"/v1/maps/{active_map}/export", params={"format": format})
    assert answer.status_code == 200
    etag = answer.headers["etag"]
    assert service.http.get(f"/v1/maps/{active_map}").json()["sha256"] in etag
    assert "immutable" in answer.headers["cache-control"]
    unchanged = service.http.get(
        f"/v1/maps/{active_map}/export", params={"format": format}, headers={"If-None-Match": etag}
    )
    assert unchanged.status_code == 304
    assert unchanged.content == b""
    again = service.http.get(f"/v1/maps/{active_map}/export", params={"format": format})
    assert again.content == answer.content
    x, y, bx = _read(format, answer.content)
    asked = service.http.post(f"/v1/maps/{active_map}/field", json={"points_m": [[x, y, 1.2]]}).json()
    assert asked["mean_ut"][0][0] == pytest.approx(bx, abs=2e-3)


@pytest.mark.parametrize("format", ["netcdf", "zarr", "npz", "csv", "covjson"])
def test_an_export_has_the_layers_of_the_fit_and_no_gradient_on_request(
    service: Any, layered_map: str, old_map: str, format: str
) -> None:
    def export(map_id: str, **more: str) -> Any:
        return service.http.get(f"/v1/maps/{map_id}/export", params={"format": format, **more})

    answers = [
        export(layered_map), export(layered_map, gradient="false"), export(old_map),
        export(layered_map, localizability="true"),
    ]  # fmt: skip
    assert [answer.status_code for answer in answers] == [200] * 4
    assert len({answer.headers["etag"] for answer in answers}) == 4
    assert [b"coverage" in answer.content for answer in answers] == [True, True, False, True]
    assert [b"dbx_dy_ut_per_m" in answer.content for answer in answers] == [True, False, True, True]
    assert [b"expected_error_m" in answer.content for answer in answers] == [False, False, False, True]
    assert answers[0].headers["content-disposition"].startswith('attachment; filename="isodyn-')


def _read(format: str, data: bytes) -> tuple[float, float, float]:
    """One measured cell of an export: x, y, bx."""
    if format == "csv":
        rows = data.decode().splitlines()
        assert rows[0].startswith("x_m,y_m,z_m,bx_ut")
        cells = rows[len(rows) // 2].split(",")
        return float(cells[0]), float(cells[1]), float(cells[3])
    if format == "covjson":
        coverage = json.loads(data)
        shape, axes = coverage["ranges"]["bx_ut"]["shape"], coverage["domain"]["axes"]
        values = np.array(coverage["ranges"]["bx_ut"]["values"], dtype=float).reshape(shape)
        x, y = axes["x"]["values"], axes["y"]["values"]
    elif format == "npz":
        with np.load(io.BytesIO(data)) as file:
            values, x, y = file["bx_ut"], file["x_m"], file["y_m"]
    else:
        with netcdf_file(io.BytesIO(data), mmap=False) as file:
            values, x, y = (np.array(file.variables[name][:]) for name in ("bx_ut", "x", "y"))
            assert file.variables["bx_ut"].units == b"uT"
    j, i = values.shape[1] // 2, values.shape[2] // 2
    return float(x[i]), float(y[j]), float(values[0, j, i])


@pytest.mark.parametrize("layer", ["norm", "bx", "sd"])
def test_heat_maps_are_pictures(service: Any, active_map: str, layer: str) -> None:
    answer = service.http.get(f"/v1/maps/{active_map}/heatmap.png", params={"layer": layer})
    assert answer.status_code == 200, answer.text
    assert answer.content.startswith(b"\x89PNG")


def test_the_nearest_height_is_the_one_picture_of_all_near_it(service: Any, active_map: str) -> None:
    path = f"/v1/maps/{active_map}/heatmap.png"
    etags = {service.http.get(path, params=asked).headers["etag"] for asked in ({}, {"height_m": 1}, {"height_m": 1.7})}
    assert len(etags) == 1, "a map of one height"
    assert service.http.get(path, params={"layer": "sd"}).headers["etag"] not in etags
    assert service.http.get(path, headers={"If-None-Match": etags.pop()}).status_code == 304
    assert service.http.get(path, params={"height_m": "nan"}).status_code == 422
    for far in (path, f"/v1/maps/{active_map}/localizability"):
        refused = service.http.get(far, params={"height_m": 1.8})
        assert refused.status_code == 422, "six decimetres from the only height"
        assert "1.20 m" in refused.json()["detail"]
        assert refused.json()["errors"][0]["location"] == "/query/height_m"


@pytest.mark.parametrize("layer", ["colour", "coverage", "horizontal", "a b\r\nc", "Ω"])
def test_a_layer_it_does_not_have_names_the_layers_there_are(service: Any, old_map: str, layer: str) -> None:
    for headers in ({}, {"If-None-Match": "*"}):
        answer = service.http.get(f"/v1/maps/{old_map}/heatmap.png", params={"layer": layer}, headers=headers)
        assert answer.status_code == 422
        assert "one of norm, bx, by, bz, inclination, sd, gradient" in answer.json()["detail"]


@pytest.fixture(scope="module")
def old_map(service: Any, active_map: str) -> str:
    """A map as it was built before fits had further layers."""
    return _copy_of_map(service, active_map, None)


@pytest.fixture(scope="module")
def layered_map(service: Any, active_map: str) -> str:
    """A map with a layer of its fit: coverage is one on the west half, two on the east."""
    with service.context.transaction() as session:
        sha256 = session.get_one(Map, active_map).grid_sha256
    grid = service.context.grids.grid(sha256)
    coverage = np.ones(grid.measured.shape, np.float32)
    coverage[:, :, grid.measured.shape[2] // 2 :] = 2.0
    return _copy_of_map(service, active_map, service.context.blobs.put(layers_to_bytes({"coverage": coverage})))


def _copy_of_map(service: Any, map_id: str, layers_sha256: str | None) -> str:
    with service.context.transaction() as session:
        row = session.get_one(Map, map_id)
        names = [column.name for column in Map.__table__.columns if column.name != "id"]
        copy = Map(**{name: getattr(row, name) for name in names} | {"layers_sha256": layers_sha256})
        session.add(copy)
        session.flush()
        return copy.id


def test_a_layer_of_the_fit_is_shown_and_has_its_own_tag(service: Any, layered_map: str, old_map: str) -> None:
    picture = service.http.get(f"/v1/maps/{layered_map}/heatmap.png", params={"layer": "coverage"})
    assert picture.content.startswith(b"\x89PNG")
    etags = [service.http.get(f"/v1/maps/{m}/heatmap.png").headers["etag"] for m in (layered_map, old_map)]
    assert etags[0] != etags[1]


def test_what_a_fit_leaves_beside_its_grid_is_kept(service: Any, active_map: str) -> None:
    with service.context.transaction() as session:
        sha256 = session.get_one(Map, active_map).layers_sha256
    layers = layers_from_bytes(service.context.blobs.get(sha256))
    assert {"coverage", "conflict"} <= set(layers)
    assert layers["coverage"].max() == 3.0, "three surveys cross the floor"
    assert service.http.get(f"/v1/maps/{active_map}/heatmap.png", params={"layer": "conflict"}).status_code == 200


def test_the_static_view_is_one_self_contained_page(service: Any, active_map: str) -> None:
    answer = service.http.get(f"/v1/maps/{active_map}/view.html")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/html")
    assert b"<html" in answer.content[:2000].lower()
    for layer in (b"norm", b"bx", b"sd", b"coverage", b"conflict", b"expected_error"):
        assert b'name="isodyn-layer" value="' + layer in answer.content
    again = service.http.get(f"/v1/maps/{active_map}/view.html", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304


def test_quality_lists_every_survey(service: Any, active_map: str) -> None:
    quality = service.http.get(f"/v1/maps/{active_map}/quality").json()
    assert set(quality["surveys"]) == set(service.http.get(f"/v1/maps/{active_map}").json()["survey_ids"])
    assert quality["measured_area_m2"] > 50


@pytest.mark.parametrize(("components", "columns"), [("level", ["horizontal", "vertical"]), ("norm", ["norm"])])
def test_poorer_components_on_request(service: Any, mapped_floor: str, components: str, columns: list[str]) -> None:
    body = {"components": components, "activate": False, "resolution_m": 0.5}
    asked = service.http.post(f"/v1/floors/{mapped_floor}/maps", json=body)
    assert asked.status_code == 202, asked.text
    service.run_jobs()
    made = service.http.get(f"/v1/maps/{asked.json()['map']['id']}").json()
    assert (made["status"], made["active"], made["components"]) == ("ready", False, components)
    assert made["resolution_m"] == 0.5
    answer = service.http.post(f"/v1/maps/{made['id']}/field", json={"points_m": [[2, 2, 1.2]]}).json()
    assert answer["components"] == columns
    assert len(answer["mean_ut"][0]) == len(columns)


def test_level_surveys_cannot_give_a_vector_map(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]
) -> None:
    floor = new_floor()
    answer = service.http.post(f"/v1/floors/{floor}/surveys", params={"frame": "level"}, content=walk_csv(1))
    assert answer.status_code == 202
    refused = service.http.post(f"/v1/floors/{floor}/maps", json={"components": "vector"})
    assert refused.status_code == 422
    assert refused.json()["type"].endswith("/incompatible-frames")
    service.run_jobs()
    active = service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    assert service.http.get(f"/v1/maps/{active}").json()["components"] == "level"


def test_activation_moves_the_pointer_both_ways(service: Any, mapped_floor: str, active_map: str) -> None:
    asked = service.http.post(f"/v1/floors/{mapped_floor}/maps", json={"activate": False, "engine": "hilbert"})
    other = asked.json()["map"]["id"]
    assert service.http.post(f"/v1/maps/{other}/activate").status_code == 409
    service.run_jobs()
    assert service.http.get(f"/v1/floors/{mapped_floor}").json()["active_map_id"] == active_map
    assert service.http.post(f"/v1/maps/{other}/activate").json()["active"] is True
    assert service.http.get(f"/v1/floors/{mapped_floor}").json()["active_map_id"] == other
    assert service.http.post(f"/v1/maps/{active_map}/activate").json()["active"] is True


def test_a_priority_is_of_the_job_not_of_the_map(service: Any, mapped_floor: str) -> None:
    def ask(priority: str) -> Any:
        return service.http.post(f"/v1/floors/{mapped_floor}/maps", json={"activate": False, "priority": priority})

    asked = {priority: ask(priority) for priority in ("low", "normal", "high")}
    assert {answer.status_code for answer in asked.values()} == {202}
    assert {priority: answer.json()["job"]["priority"] for priority, answer in asked.items()} == {
        "low": "low", "normal": "normal", "high": "high",
    }  # fmt: skip
    assert ask("urgent").status_code == 422
    service.run_jobs()
    maps = [service.http.get(f"/v1/maps/{answer.json()['map']['id']}").json() for answer in asked.values()]
    assert len({row["sha256"] for row in maps}) == 1
    assert {row["status"] for row in maps} == {"ready"}


def test_a_map_of_nothing_is_refused(service: Any, new_floor: Callable[..., str]) -> None:
    floor = new_floor()
    assert service.http.post(f"/v1/floors/{floor}/maps", json={}).status_code == 409
    unknown = service.http.post(f"/v1/floors/{floor}/maps", json={"survey_ids": ["nope"]})
    assert unknown.status_code == 422
    assert "nope" in unknown.text


def test_an_older_build_never_replaces_a_newer_one(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]
) -> None:
    from app.services.build_map import claim_build, fit_build, publish_build

    floor = new_floor(auto_build=False)
    service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1))
    jobs = [service.http.post(f"/v1/floors/{floor}/maps", json={}).json()["job"]["id"] for _ in range(2)]
    plans = []
    for job in jobs:
        with service.context.transaction() as session:
            plans.append(claim_build(session, job))
    results = [fit_build(plan, service.context.blobs, lambda fraction, message: None) for plan in plans]
    for k in (1, 0):
        with service.context.transaction() as session:
            publish_build(session, jobs[k], plans[k], results[k])
    assert service.http.get(f"/v1/floors/{floor}").json()["active_map_id"] == plans[1]["map_id"]
    assert results[0]["grid_sha256"] == results[1]["grid_sha256"], "the same surveys give the same map"


@pytest.mark.parametrize(
    "database_url", ["sqlite", pytest.param("postgres", marks=[pytest.mark.postgres, pytest.mark.slow])], indirect=True
)
def test_a_compromise_map_on_request_says_how_near_it_is(service: Any, mapped_floor: str) -> None:
    body = {"engine": "compromise", "components": "norm", "activate": False, "resolution_m": 0.5}
    asked = service.http.post(f"/v1/floors/{mapped_floor}/maps", json=body)
    assert asked.status_code == 202, asked.text
    service.run_jobs()
    made = service.http.get(f"/v1/maps/{asked.json()['map']['id']}").json()
    assert (made["status"], made["engine"]) == ("ready", "compromise")
    assert made["hyperparameters"]["nodes"] > 8
    assert made["hyperparameters"]["rmse_against_intermediate_ut"][0] < 0.1
    assert made["score"]["rmse_ut"][0] < 5.0


@pytest.mark.parametrize(
    "body",
    [
        {"curl_free": True, "engine": "exact"},
        {"curl_free": True, "components": "norm"},
        {"kernel": "matern32+matern32", "curl_free": True},
        {"heights_m": [2.0, 1.0]},
        {"kernel": "matern32+matern32", "engine": "exact"},
        {"robust": True, "engine": "exact"},
        {"refine": True, "engine": "exact"},
    ],
)
def test_parameters_that_do_not_go_together_are_refused(service: Any, mapped_floor: str, body: dict[str, Any]) -> None:
    answer = service.http.post(f"/v1/floors/{mapped_floor}/maps", json=body)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["location"] == f"/body/{next(iter(body))}"


@pytest.mark.parametrize(
    "body",
    [
        {"curl_free": True, "heights_m": [0.9, 1.5], "noise": "white"},
        {"kernel": "matern32+matern32", "robust": True},
        {"refine": True},
    ],
)
def test_every_kind_of_map_can_be_built_and_asked(service: Any, mapped_floor: str, body: dict[str, Any]) -> None:
    answer = service.http.post(f"/v1/floors/{mapped_floor}/maps", json=body | {"resolution_m": 0.5, "activate": False})
    assert answer.status_code == 202, answer.text
    service.run_jobs()
    map_id = answer.json()["map"]["id"]
    shown = service.http.get(f"/v1/maps/{map_id}").json()
    assert shown["status"] == "ready"
    quality = service.http.get(f"/v1/maps/{map_id}/quality").json()
    assert bool(quality["refinement"]) == body.get("refine", False) == ("refinement" in shown["hyperparameters"])
    heights = body.get("heights_m")
    bounds = shown["bounds_m"]
    centre = [(bounds[0] + bounds[3]) / 2, (bounds[1] + bounds[4]) / 2, 1.2]
    field = service.http.post(f"/v1/maps/{map_id}/field", json={"points_m": [centre], "gradient": True}).json()
    assert field["measured"] == [True]
    slopes = field["gradient_ut_per_m"][0]
    assert (slopes[0][2] is None) == (heights is None)
    if heights:
        assert [bounds[2], bounds[5]] == heights
        assert slopes[0][1] == pytest.approx(slopes[1][0], abs=1e-6)
        assert slopes[0][2] == pytest.approx(slopes[2][0], abs=1e-6)


def test_a_rebuild_continues_the_last_fit_and_says_what_changed(service: Any, new_floor: Any, walk_csv: Any) -> None:
    floor = new_floor()
    for seed in (1, 2, 3):
        survey = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(seed, offset_m=0.2 * seed)).json()
    last = survey["survey"]["id"]

    def rebuilt() -> dict[str, Any]:
        service.run_jobs()
        active = service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
        shown = service.http.get(f"/v1/maps/{active}").json()
        return shown | {"changes": service.http.get(f"/v1/maps/{active}/quality").json()["changes"]}

    first = rebuilt()
    blobs = service.blob_count()
    assert service.http.patch(f"/v1/surveys/{last}", json={"included": False}).status_code == 200
    without = rebuilt()
    assert service.http.patch(f"/v1/surveys/{last}", json={"included": True}).status_code == 200
    again = rebuilt()
    assert first["changes"]["hyperparameters"] == "learned"
    assert without["changes"]["hyperparameters"] == again["changes"]["hyperparameters"] == "kept"
    assert without["changes"]["surveys_removed"] == again["changes"]["surveys_added"] == [last]
    assert without["sha256"] != first["sha256"] == again["sha256"]
    assert service.blob_count() == blobs + 5, "two grids, layers, three reports, and of the states of fits the last two"


@pytest.mark.parametrize(
    ("asked", "shown"),
    [
        ({}, {"kernel": "matern32", "noise": "walk", "hard_iron": True, "heights_m": None, "robust": False}),
        ({"curl_free": True}, {"kernel": "squared_exponential", "curl_free": True, "refine": False}),
        ({"heights_m": [0.9, 1.5], "noise": "white", "hard_iron": False, "robust": True}, {"curl_free": False}),
        ({"kernel": "matern52+matern52", "refine": True}, {}),
    ],
)
def test_a_map_shows_what_was_asked_for(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes], asked: Any, shown: Any
) -> None:
    floor = new_floor(auto_build=False)
    service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1))
    answer = service.http.post(f"/v1/floors/{floor}/maps", json=asked).json()
    made = service.http.get(f"/v1/maps/{answer['map']['id']}").json()
    assert made == answer["map"]
    assert {name: made[name] for name in asked | shown} == asked | shown
    service.http.delete(f"/v1/jobs/{answer['job']['id']}")


def test_a_floor_that_outgrows_the_exact_engine_is_built_by_the_default_one(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]
) -> None:
    floor = new_floor()
    asked = {"engine": "exact", "components": "norm", "resolution_m": 0.5}

    def upload(*walk: float) -> tuple[dict[str, Any], dict[str, Any]]:
        """The job that follows, and its map."""
        job = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(*walk)).json()["job"]
        service.run_jobs()
        ended = service.http.get(f"/v1/jobs/{job['id']}").json()
        return ended, service.http.get(f"/v1/maps/{ended['map_id']}").json()

    upload(1, 4.0, 3.0)
    assert service.http.post(f"/v1/floors/{floor}/maps", json=asked).status_code == 202
    service.run_jobs()
    job, still = upload(2, 4.0, 3.0)
    assert (still["engine"], job["result"]["changes"]["fallback"]) == ("exact", None)
    for walk in ((3, 100.0, 8.0), (4, 6.0, 4.0)):
        job, grown = upload(*walk)
        assert (job["status"], grown["active"], grown["engine"]) == ("successful", True, "hilbert")
        assert (grown["components"], grown["resolution_m"]) == ("norm", 0.5), "the rest stays as asked"
        quality = service.http.get(f"/v1/maps/{grown['id']}/quality").json()
        told = quality["changes"]["fallback"]
        if walk[0] == 3:
            assert "at most 2000 observations" in told
            assert told in job["message"]
        else:
            assert told is None, "it was said once"
            assert quality["changes"]["hyperparameters"] == "kept"
    refused = service.http.post(f"/v1/floors/{floor}/maps", json=asked)
    assert refused.status_code == 422
    assert refused.json()["errors"][0]["location"] == "/body/engine"
    few = still["survey_ids"]
    assert service.http.post(f"/v1/floors/{floor}/maps", json=asked | {"survey_ids": few}).status_code == 202
    service.run_jobs()


def test_pointers_have_etags_that_follow_their_state(service: Any, mapped_floor: str, active_map: str) -> None:
    for path in (f"/v1/floors/{mapped_floor}", f"/v1/maps/{active_map}"):
        first = service.http.get(path)
        assert "max-age=" in first.headers["cache-control"]
        etag = first.headers["etag"]
        for sent in (etag, f'"other", W/{etag}', "*"):
            assert service.http.get(path, headers={"If-None-Match": sent}).status_code == 304
        assert service.http.get(path, headers={"If-None-Match": '"other"'}).status_code == 200
