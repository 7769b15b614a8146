"""Tracks over HTTP: their life from the first step to the last, and what is refused."""

import json
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest
from sqlalchemy import select, update

from app.db.tables import Key, Track
from app.services.step_rate import StepRate

Steps = list[dict[str, Any]]
OPTIONS = {"particles": 1000}
POLYGON = {"type": "Polygon", "coordinates": [[[0, 0], [12, 0], [12, 8], [0, 8], [0, 0]]]}


@pytest.fixture(scope="module")
def hall(service: Any, put_hall: Any) -> tuple[str, str]:
    with service.context.transaction() as session:
        ids: tuple[str, str] = put_hall(session, service.context.blobs)
    return ids


@pytest.fixture
def begin(service: Any, hall: tuple[str, str]) -> Iterator[Callable[..., Any]]:
    """Begin a track in the hall; all are removed afterwards."""
    made = []

    def make(**more: Any) -> Any:
        answer = service.http.post(
            "/v1/tracks", json={"building_id": hall[0], "frame": "level", "options": OPTIONS, "seed": 7, **more}
        )
        assert answer.status_code == 201, answer.text
        made.append(answer.json()["id"])
        return answer.json()

    yield make
    for track_id in made:
        service.http.delete(f"/v1/tracks/{track_id}")


def send(service: Any, track: Any, steps: Steps, **more: Any) -> Any:
    return service.http.post(f"/v1/tracks/{track['id']}/steps", json={"steps": steps, **more})


def sent(service: Any, track: Any, steps: Steps, size: int = 20) -> list[dict[str, Any]]:
    answers = [send(service, track, steps[k : k + size]) for k in range(0, len(steps), size)]
    assert [each.status_code for each in answers] == [200] * len(answers), answers[-1].text
    return [each.json() for each in answers]


def problem(answer: Any, status: int, kind: str) -> Any:
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json"), answer.text
    assert answer.json()["type"].endswith(kind)
    return answer.json()


def test_a_track_from_its_first_step_to_its_end(
    service: Any, hall: tuple[str, str], begin: Any, hall_steps: Callable[..., Steps], hall_place_m: Any
) -> None:
    track, steps = begin(name="phone 3"), hall_steps(count=300)
    path = f"/v1/tracks/{track['id']}"
    assert (track["status"], track["next_step"], track["frame"], track["seed"]) == ("active", 0, "level", 7)
    assert (track["building_id"], track["floor_ids"]) == (hall[0], [hall[1]])
    assert track["estimate"]["state"] == "searching"
    assert track["links"]["steps"] == f"{path}/steps"
    answers = sent(service, track, steps)
    assert "walk on" in answers[0]["estimate"]["reason"]
    last = answers[-1]
    estimate = last["estimate"]
    assert (last["next_step"], last["accepted"], last["waiting"], estimate["step"]) == (300, 20, 0, 299)
    assert (estimate["state"], estimate["reason"], estimate["floor_id"]) == ("converged", None, hall[1])
    for answer in answers[8:]:
        told = answer["estimate"]
        off_m = np.linalg.norm(np.array(told["position_m"][:2]) - hall_place_m(told["step"]))
        assert off_m < 0.5
        assert np.linalg.eigvalsh(told["covariance_m2"]).min() > 0.0
        assert sum(each["probability"] for each in told["modes"]) <= 1.0 + 1e-9
    shown = service.http.get(path).json()
    assert (shown["next_step"], shown["estimate"]) == (300, estimate)
    assert shown["last_step_at"] > shown["created_at"]
    ended = service.http.post(f"{path}/end").json()
    assert (ended["status"], ended["ended_reason"]) == ("ended", "asked")
    assert service.http.post(f"{path}/end").json() == ended, "once more changes nothing"
    assert "asked to end" in problem(send(service, track, steps[:1]), 409, "conflict")["detail"]
    assert service.http.get(f"{path}/path").status_code == 200
    assert service.http.delete(path).status_code == 204
    assert service.http.get(path).status_code == 404
    with service.context.transaction() as session:
        assert session.get(Track, track["id"]) is None


@pytest.mark.parametrize("frame", ["building", "body", "norm"])
def test_every_frame_is_followed(
    service: Any, begin: Any, hall_steps: Callable[..., Steps], hall_place_m: Any, frame: str
) -> None:
    track = begin(frame=frame)
    told = sent(service, track, hall_steps(frame, 200))[-1]["estimate"]
    off_m = np.linalg.norm(np.array(told["position_m"][:2]) - hall_place_m(199))
    assert (told["state"], bool(off_m < 1.0)) == ("converged", True), (told, off_m)


def test_a_path_is_paged_and_smoothed_from_both_sides(
    service: Any, begin: Any, hall_steps: Callable[..., Steps], hall_place_m: Any
) -> None:
    track, steps = begin(), hall_steps(count=300)
    answers = sent(service, track, steps)
    seen, url = [], f"/v1/tracks/{track['id']}/path?limit=70"
    while url:
        page = service.http.get(url).json()
        assert len(page["points"]) <= 70
        seen += page["points"]
        url = page["links"].get("next")
    assert [each["step"] for each in seen] == list(range(300))
    for answer in answers:
        told, point = answer["estimate"], seen[answer["estimate"]["step"]]
        assert {
            name: point[name] for name in ("state", "position_m", "covariance_m2", "radius_95_m", "heading_rad")
        } == {name: told[name] for name in ("state", "position_m", "covariance_m2", "radius_95_m", "heading_rad")}
    smoothed = service.http.get(f"/v1/tracks/{track['id']}/path?smoothed=true").json()["points"]
    settled = [each["settled"] for each in smoothed]
    assert settled == sorted(settled, reverse=True), "settled ones first"
    assert {True, False} == set(settled)
    assert len(smoothed) > 50
    assert all(np.linalg.eigvalsh(each["covariance_m2"]).min() >= -1e-9 for each in smoothed)
    off_m = [np.linalg.norm(np.array(each["position_m"][:2]) - hall_place_m(each["step"])) for each in smoothed]
    assert np.median(off_m) < 0.25
    page = service.http.get(f"/v1/tracks/{track['id']}/path?smoothed=true&from_step=100&limit=3").json()
    assert [each["step"] for each in page["points"]] == [e["step"] for e in smoothed if e["step"] >= 100][:3]
    assert page["links"]["next"]
    stored = service.http.get(f"/v1/tracks/{track['id']}/steps?from_step=50&limit=40").json()
    assert stored["steps"] == steps[50:90]
    assert stored["links"]["next"].endswith("from_step=90&limit=40")


def test_a_replay_is_equal_bit_for_bit_and_changes_nothing(
    service: Any, begin: Any, hall_steps: Callable[..., Steps]
) -> None:
    track = begin()
    answers = sent(service, track, hall_steps(count=160))
    before = service.row_counts()
    replayed = service.http.post(f"/v1/tracks/{track['id']}/replay")
    assert replayed.headers["content-type"] == "application/x-ndjson"
    *lines, end = [json.loads(line) for line in replayed.text.splitlines()]
    assert [line["estimate"] for line in lines] == [answer["estimate"] for answer in answers]
    assert all(line["equal"] for line in lines)
    assert (end["kind"], end["equal"], end["batches"], end["different"]) == ("end", True, 8, 0)
    again = json.loads(service.http.post(f"/v1/tracks/{track['id']}/replay").text.splitlines()[-1])
    assert again["sha256"] == end["sha256"]
    assert service.row_counts() == before
    with service.context.transaction() as session:
        session.execute(update(Track).where(Track.id == track["id"]).values(seed=8))
    end = json.loads(service.http.post(f"/v1/tracks/{track['id']}/replay").text.splitlines()[-1])
    assert not end["equal"]


def test_steps_may_come_twice_out_of_order_and_late(service: Any, begin: Any, hall_steps: Callable[..., Steps]) -> None:
    track, straight, steps = begin(), begin(), hall_steps(count=80)
    for answer, told in (
        (send(service, track, steps[:10][::-1]), (10, 10, 0, 0, 0)),
        (send(service, track, steps[5:15]), (15, 5, 5, 0, 0)),
        (send(service, track, [steps[16], steps[17], steps[17]]), (15, 2, 1, 0, 2)),
        (send(service, track, [steps[16]]), (15, 0, 1, 0, 2)),
        (send(service, track, [steps[15]]), (18, 1, 0, 0, 0)),
        (send(service, track, steps[20:25]), (18, 5, 0, 0, 5)),
        (send(service, track, steps[25:31]), (31, 6, 0, 0, 0)),  # a second after the gap it is given up
        (send(service, track, steps[17:20]), (31, 0, 1, 2, 0)),
        (send(service, track, steps[33:36], flush=True), (36, 3, 0, 0, 0)),
        (send(service, track, steps[:36]), (36, 0, 32, 4, 0)),
    ):
        body = answer.json()
        names = ("next_step", "accepted", "duplicates", "late", "waiting")
        assert tuple(body[name] for name in names) == told, body
    known = [step for step in steps[:36] if step["number"] not in (18, 19, 31, 32)]
    assert send(service, straight, known, flush=True).json()["next_step"] == 36
    ways = [service.http.get(f"/v1/tracks/{each['id']}/path").json()["points"] for each in (track, straight)]
    assert ways[0] == ways[1], "the order of arrival does not matter"


def faulty(steps: Steps, at: int, **change: Any) -> Steps:
    return [{**step, **change} if k == at else step for k, step in enumerate(steps)]


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "earlier": ({"t_s": -1.0}, "/body/steps/3/t_s"),
    "too far": ({"displacement_m": [500.0, 0.0, 0.0]}, "/body/steps/3/displacement_m"),
    "out of the world": ({"displacement_m": [1e7, 0.0, 0.0]}, "/body/steps/3/displacement_m/0"),
    "not a number": ({"number": -1}, "/body/steps/3/number"),
    "a magnitude": ({"b_ut": 50.0}, "/body/steps/3/b_ut"),
    "saturated": ({"b_ut": [5000.0, 0.0, 0.0]}, "/body/steps/3/b_ut"),
    "two components": ({"b_ut": [5.0, 0.0]}, "/body/steps/3/b_ut"),
    "an orientation": ({"orientation": [1.0, 0.0, 0.0, 0.0]}, "/body/steps/3/orientation"),
    "half a heading": ({"heading_sd_rad": 0.1}, "/body/steps/3"),
    "unknown": ({"b_nt": 1.0}, "/body/steps/3/b_nt"),
}


def test_a_fault_says_where_and_leaves_everything_as_it_was(
    service: Any, begin: Any, hall_steps: Callable[..., Steps]
) -> None:
    track, steps = begin(), hall_steps(count=40)
    sent(service, track, steps[:20])
    before = service.http.get(f"/v1/tracks/{track['id']}").json()
    for name, (change, where) in FAULTS.items():
        told = problem(send(service, track, faulty(steps[20:30], 3, **change)), 422, "invalid-input")
        assert told["errors"][0]["location"] == where, (name, told)
    assert problem(send(service, track, []), 422, "invalid-input")
    assert problem(send(service, track, steps[:1] * 501), 422, "invalid-input")
    assert service.http.get(f"/v1/tracks/{track['id']}").json() == before
    assert service.http.get(f"/v1/tracks/{track['id']}/steps").json()["steps"] == steps[:20]
    assert send(service, track, steps[20:30]).json()["next_step"] == 30


def test_another_unit_is_noticed_and_a_magnet_is_not_taken_for_one(
    service: Any, begin: Any, hall_steps: Callable[..., Steps]
) -> None:
    track, steps = begin(), hall_steps(count=30)
    milligauss = [{**step, "b_ut": [10 * b for b in step["b_ut"]]} for step in steps]
    assert "milligauss" in problem(send(service, track, milligauss), 422, "invalid-input")["detail"]
    assert "milligauss" in problem(send(service, track, milligauss[:1]), 422, "invalid-input")["detail"]
    sent(service, track, steps[:10])
    assert send(service, track, [{**steps[10], "b_ut": [180.0, 0.0, 0.0]}]).status_code == 200
    assert send(service, track, [{"number": 11, "t_s": 1.2}]).status_code == 200, "nothing measured, nothing reckoned"


def test_body_steps_need_a_unit_orientation(service: Any, begin: Any, hall_steps: Callable[..., Steps]) -> None:
    track, steps = begin(frame="body"), hall_steps("body", 5)
    for change in ({"orientation": None}, {"orientation": [2.0, 0.0, 0.0, 0.0]}):
        told = problem(send(service, track, faulty(steps, 3, **change)), 422, "invalid-input")
        assert told["errors"][0]["location"] == "/body/steps/3/orientation"
    assert send(service, track, steps).status_code == 200


def test_a_track_stays_on_its_maps(service: Any, hall: tuple[str, str], begin: Any, put_hall: Any) -> None:
    track = begin(options={"noise_ut": 0.8, "particles": 300, "window_m": 10})
    options = track["options"]
    assert (options["noise_ut"], options["particles"], options["window_m"]) == (0.8, 300, 10)
    assert options["least_particles"] <= 300
    assert track["map_ids"] == [service.http.get(f"/v1/floors/{hall[1]}").json()["active_map_id"]]
    by_floor = begin(building_id=None, floor_ids=[hall[1]])
    assert by_floor["building_id"] == hall[0]
    assert by_floor["seed"] == 7


def test_seeds_differ_unless_given(begin: Any) -> None:
    assert begin(seed=None)["seed"] != begin(seed=None)["seed"]


BAD_GROUND: dict[str, tuple[dict[str, Any], str]] = {
    "a point": ({"walkable": {"type": "Point", "coordinates": [0, 0]}}, "/body/options/walkable/type"),
    "an open ring": (
        {"walkable": {"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 1]]]}},
        "/body/options/walkable/coordinates/0",
    ),
    "not numbers": (
        {"walls": {"type": "LineString", "coordinates": [[0, 0], [1, "x"]]}},
        "/body/options/walls/coordinates/1/1",
    ),
    "one position": ({"walls": {"type": "LineString", "coordinates": [[0, 0]]}}, "/body/options/walls/coordinates"),
    "of an unknown floor": ({"walls": {"nowhere": {}}}, "/body/options/walls/nowhere"),
    "elsewhere": (
        {"walkable": {"type": "Polygon", "coordinates": [[[90, 90], [99, 90], [99, 99], [90, 99], [90, 90]]]}},
        "/body/options/walkable",
    ),
    "too wide": ({"walls": {"type": "LineString", "coordinates": [[0, 0], [5000, 0]]}}, "/body/options/walkable"),
    "stairs to nowhere": (
        {"connectors": [{"kind": "stairs", "floor_ids": ["nowhere", "x"], "polygon": POLYGON}]},
        "/body/options/connectors/0/floor_ids/0",
    ),
    "a slide": (
        {"connectors": [{"kind": "slide", "floor_ids": ["a", "b"], "polygon": POLYGON}]},
        "/body/options/connectors/0/kind",
    ),
}


def test_ground_that_cannot_be_used_says_where(service: Any, hall: tuple[str, str]) -> None:
    before = service.row_counts()
    for name, (options, where) in BAD_GROUND.items():
        body = {"building_id": hall[0], "frame": "level", "options": options}
        told = problem(service.http.post("/v1/tracks", json=body), 422, "invalid-input")
        assert told["errors"][0]["location"] == where, (name, told)
    assert service.row_counts() == before


def test_ground_is_taken_with_the_track(
    service: Any, hall: tuple[str, str], begin: Any, hall_steps: Callable[..., Steps]
) -> None:
    walls = {hall[1]: {"type": "MultiLineString", "coordinates": [[[5, 0], [5, 1]], [[6, 0], [6, 1]]]}}
    track = begin(options={**OPTIONS, "walkable": POLYGON, "walls": walls})
    assert sent(service, track, hall_steps(count=100))[-1]["estimate"]["state"] == "converged"
    prior = {"position_m": [1.0, 1.0, 1.2], "sd_m": 1.0}
    told = sent(service, begin(prior=prior), hall_steps(count=20))[-1]["estimate"]
    assert told["floor_id"] == hall[1], "found at once"


def test_what_cannot_be_followed_is_refused(
    service: Any, hall: tuple[str, str], new_floor: Callable[..., str], building: str, put_hall: Any
) -> None:
    bare = new_floor()
    with service.context.transaction() as session:
        _, other = put_hall(session, service.context.blobs)
    for body, status, kind in (
        ({}, 422, "invalid-input"),
        ({"floor_ids": [bare]}, 409, "conflict"),
        ({"building_id": service.http.post("/v1/buildings", json={"name": "Bare"}).json()["id"]}, 409, "conflict"),
        ({"building_id": "nothing"}, 404, "not-found"),
        ({"floor_ids": ["nothing"]}, 404, "not-found"),
        ({"floor_ids": [hall[1], other]}, 422, "invalid-input"),
        ({"building_id": hall[0], "frame": "ned"}, 422, "invalid-input"),
        ({"building_id": hall[0], "options": {"particles": 10**6}}, 422, "invalid-input"),
        ({"building_id": hall[0], "options": {"bogus": 1}}, 422, "invalid-input"),
        ({"building_id": hall[0], "seed": -1}, 422, "invalid-input"),
    ):
        problem(service.http.post("/v1/tracks", json={"frame": "level", **body}), status, kind)


def test_a_repeated_request_makes_one_track(service: Any, hall: tuple[str, str]) -> None:
    body, headers = {"building_id": hall[0], "frame": "level"}, {"Idempotency-Key": "track-1"}
    one, two = (service.http.post("/v1/tracks", json=body, headers=headers) for _ in range(2))
    assert one.json() == two.json()
    assert two.headers["idempotent-replayed"] == "true"
    service.http.delete(f"/v1/tracks/{one.json()['id']}")


def test_tracks_are_listed_by_building_and_status(service: Any, hall: tuple[str, str], begin: Any) -> None:
    made = [begin()["id"] for _ in range(3)]
    service.http.post(f"/v1/tracks/{made[1]}/end")
    with service.context.transaction() as session:
        long_ago = datetime.now(UTC) - timedelta(hours=1)
        session.execute(update(Track).where(Track.id == made[2]).values(touched_at=long_ago))

    def ids(**asked: Any) -> list[str]:
        items = service.http.get("/v1/tracks", params={"limit": 200, **asked}).json()["items"]
        return [each["id"] for each in items if each["id"] in made]

    assert ids() == ids(building_id=hall[0]) == made
    assert ids(building_id="other") == []
    assert (ids(status="active"), ids(status="ended")) == ([made[0]], made[1:])
    idle = service.http.get(f"/v1/tracks/{made[2]}").json()
    assert (idle["status"], idle["ended_reason"]) == ("ended", "idle")
    assert service.context.follower.end_idle() >= 1
    assert service.http.get(f"/v1/tracks/{made[2]}").json()["ended_at"] is not None


def test_an_idle_track_takes_no_steps(service: Any, begin: Any, hall_steps: Callable[..., Steps]) -> None:
    track, steps = begin(), hall_steps(count=20)
    sent(service, track, steps[:10])
    with service.context.transaction() as session:
        long_ago = datetime.now(UTC) - timedelta(seconds=601)
        session.execute(update(Track).where(Track.id == track["id"]).values(touched_at=long_ago))
    service.context.follower.forget(track["id"])
    assert "no step came for 600 s" in problem(send(service, track, steps[10:]), 409, "conflict")["detail"]


def test_a_key_has_so_many_tracks_at_once(
    service: Any, hall: tuple[str, str], key_with: Callable[..., dict[str, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    headers = key_with("locate")
    monkeypatch.setattr(service.context.settings, "max_tracks_per_key", 2)
    body = {"building_id": hall[0], "frame": "level"}
    made = [service.http.post("/v1/tracks", json=body, headers=headers).json()["id"] for _ in range(2)]
    refused = service.http.post("/v1/tracks", json=body, headers=headers)
    assert "2 active tracks" in problem(refused, 429, "too-many")["detail"]
    assert int(refused.headers["retry-after"]) >= 1
    assert service.http.post(f"/v1/tracks/{made[0]}/end", headers=headers).status_code == 200
    assert service.http.post("/v1/tracks", json=body, headers=headers).status_code == 201
    with service.context.transaction() as session:
        assert len(session.scalars(select(Key)).all()) >= 2


def test_steps_come_no_faster_than_they_may(
    service: Any, begin: Any, hall_steps: Callable[..., Steps], monkeypatch: pytest.MonkeyPatch
) -> None:
    track, steps = begin(), hall_steps(count=120)
    now = [0.0]
    slow = StepRate(1.0, lambda: now[0])
    monkeypatch.setattr(service.context.step_rate, "take", slow.take)
    assert send(service, track, steps[:60]).status_code == 200
    refused = send(service, track, steps[60:70])
    assert "in 10.0 s" in problem(refused, 429, "too-many")["detail"]
    assert refused.headers["retry-after"] == "10"
    now[0] = 10.0
    assert send(service, track, steps[60:70]).json()["next_step"] == 70


def test_nobody_elses_track_is_found(
    service: Any, begin: Any, hall_steps: Callable[..., Steps], stranger: dict[str, str], key_with: Any
) -> None:
    track, steps = begin(), hall_steps(count=10)
    sent(service, track, steps)
    path = f"/v1/tracks/{track['id']}"
    for method, url, body in (
        ("GET", path, None), ("GET", f"{path}/path", None), ("GET", f"{path}/path?smoothed=true", None),
        ("GET", f"{path}/steps", None), ("POST", f"{path}/steps", {"steps": steps}), ("POST", f"{path}/replay", None),
        ("POST", f"{path}/end", None), ("DELETE", path, None),
    ):  # fmt: skip
        problem(service.http.request(method, url, json=body, headers=stranger), 404, "not-found")
        problem(service.http.request(method, url, json=body, headers=key_with("map:read")), 403, "forbidden")
    assert service.http.get("/v1/tracks", headers=stranger).json()["items"] == []
    assert service.http.get(path, headers=key_with("locate")).status_code == 200
