"""Uploads: what is taken, what is refused, and that a refusal stores nothing."""

import gzip
import json
import threading
import zlib
from collections.abc import Callable
from typing import Any

import pytest
import zstandard

HEADER = "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut"
Walk = Callable[..., bytes]
NewFloor = Callable[..., str]


def test_a_survey_is_received_mapped_and_judged(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor = new_floor()
    ids = []
    for seed in (1, 2, 3):
        answer = service.http.post(
            f"/v1/floors/{floor}/surveys", params={"name": f"walk {seed}"}, content=walk_csv(seed, offset_m=0.2 * seed)
        )
        assert answer.status_code == 202
        assert answer.json()["job"]["status"] == "accepted"
        ids.append(answer.json()["survey"]["id"])
    service.run_jobs()
    job = service.http.get(f"/v1/jobs/{answer.json()['job']['id']}").json()
    assert job["status"] == "successful", job
    assert job["progress"] == 100
    floor_map = service.http.get(f"/v1/maps/{job['map_id']}").json()
    assert floor_map["active"]
    assert sorted(floor_map["survey_ids"]) == sorted(ids)
    assert max(floor_map["score"]["rmse_ut"]) < 1.0, floor_map["score"]
    verdict = service.http.get(f"/v1/surveys/{ids[0]}/consistency").json()
    assert verdict["status"] == "consistent", verdict
    assert [c["component"] for c in verdict["components"]] == ["bx", "by", "bz"]
    assert verdict["change_point"] is None
    told = verdict["localizability"]
    assert told["step_m"] == 0.05
    assert told["glm_ratio_of_means"] == pytest.approx(told["mean_signal_ut"] / told["mean_noise_ut"])
    assert told["mean_noise_ut"] == pytest.approx(sum(c["rmse_ut"] ** 2 for c in verdict["components"]) ** 0.5, rel=0.2)
    assert 0.1 < told["mean_signal_ut"] < 0.7, "fields of 2 to 14 uT/m"
    assert told["glm_p5"] < told["glm_p50"] < told["glm_p95"]
    scored = floor_map["score"]
    assert scored["rmse_vec_ut"] == pytest.approx(sum(rmse**2 for rmse in scored["rmse_ut"]) ** 0.5)
    assert 0.0 < scored["rmse_of_norm_ut"] <= scored["rmse_vec_ut"]
    assert len(scored["sharpness_ut"]) == 3
    quality = service.http.get(f"/v1/maps/{job['map_id']}/quality").json()
    assert quality["out_of_date"] == []
    assert quality["score"] == scored
    report = service.http.get(f"/v1/surveys/{ids[0]}/report").json()
    assert report
    samples = service.http.get(f"/v1/surveys/{ids[0]}/samples", params={"limit": 10}).json()
    assert samples["columns"] == ["t_s", "x_m", "y_m", "z_m", "bx_ut", "by_ut", "bz_ut"]
    assert 5 <= len(samples["rows"]) <= 10


def as_ndjson(data: bytes) -> bytes:
    header, *rows = data.decode().split()
    columns = header.split(",")
    records = [dict(zip(columns, map(float, row.split(",")), strict=True)) for row in rows]
    return "\n".join(map(json.dumps, records)).encode()


def upload(service: Any, floor: str, data: bytes, **asked: object) -> Any:
    return service.http.post(f"/v1/floors/{floor}/surveys", params=asked, content=data)


def surveys_of(service: Any, floor: str) -> list[str]:
    return [each["id"] for each in service.http.get(f"/v1/floors/{floor}/surveys").json()["items"]]


def test_equal_samples_are_the_same_survey_whatever_the_format(
    service: Any, new_floor: NewFloor, walk_csv: Walk
) -> None:
    floor, elsewhere, data = new_floor(), new_floor(), walk_csv(4)
    first = upload(service, floor, data).json()
    again = upload(service, floor, as_ndjson(data), format="ndjson", name="the same")
    assert (again.status_code, again.json()) == (200, first)
    assert upload(service, elsewhere, as_ndjson(data), format="ndjson").status_code == 202
    assert upload(service, floor, data, frame="level").status_code == 202, "read otherwise: other samples"
    assert len(surveys_of(service, floor)) == 2


def test_what_was_left_out_stays_out_and_what_was_deleted_comes_again(
    service: Any, new_floor: NewFloor, walk_csv: Walk
) -> None:
    floor, data = new_floor(), walk_csv(4)
    url = f"/v1/surveys/{upload(service, floor, data).json()['survey']['id']}"
    service.http.patch(url, json={"included": False})
    for answer in (upload(service, floor, data), upload(service, floor, as_ndjson(data), format="ndjson")):
        assert answer.status_code == 200
        assert (answer.json()["survey"]["included"], answer.json()["job"]) == (False, None)
    assert service.http.delete(url).status_code == 204
    again = upload(service, floor, as_ndjson(data), format="ndjson")
    assert again.status_code == 202
    assert again.json()["survey"]["included"]


QUATERNIONS = ",qw,qx,qy,qz"


def with_attitude(data: bytes) -> bytes:
    """The same walk by a sensor that never turned."""
    header, *rows = data.decode().split()
    return "\n".join([header + QUATERNIONS, *(row + ",1,0,0,0" for row in rows)]).encode()


def test_an_upload_may_say_its_calibration_session(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor, data = new_floor(), with_attitude(walk_csv(1))
    answer = upload(service, floor, data, session="robot-7 monday")
    assert answer.status_code == 202, answer.text
    survey = answer.json()["survey"]
    assert survey["session"] == "robot-7 monday"
    assert service.http.get(f"/v1/surveys/{survey['id']}/report").json()["session"] == "robot-7 monday"
    upload(service, floor, with_attitude(walk_csv(2, offset_m=0.3)), session="robot-7 monday")
    service.run_jobs()
    active = service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    quality = service.http.get(f"/v1/maps/{active}/quality").json()
    assert list(quality["hard_iron"]["sessions"]) == ["robot-7 monday"]
    assert upload(service, floor, data).json()["survey"] == survey, "nothing said, nothing contradicted"
    other = upload(service, floor, data, session="robot-7 tuesday")
    assert other.status_code == 409
    assert f"replaces={survey['id']}" in other.json()["detail"]
    twin = upload(service, floor, as_ndjson(data), format="ndjson", session="robot-7 tuesday")
    assert twin.status_code == 202, "another offset, other samples"
    assert upload(service, floor, data, session="robot-7 tuesday").json()["survey"] == twin.json()["survey"]
    service.http.delete(f"/v1/surveys/{twin.json()['survey']['id']}")
    instead = upload(service, floor, data, session="robot-7 tuesday", replaces=survey["id"])
    assert instead.status_code == 202
    assert instead.json()["survey"]["session"] == "robot-7 tuesday"
    assert len(surveys_of(service, floor)) == 2


@pytest.mark.parametrize("format", ["csv", "indoor-location-2020"])
def test_a_session_is_refused_where_it_means_nothing(
    service: Any, mapped_floor: str, walk_csv: Walk, format: str
) -> None:
    before = service.row_counts(), service.blob_count()
    answer = upload(service, mapped_floor, walk_csv(1), format=format, session="monday")
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["location"] == "session"
    assert (service.row_counts(), service.blob_count()) == before


def test_a_survey_takes_the_place_of_another_in_one_step(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor = new_floor()
    old = upload(service, floor, walk_csv(1)).json()["survey"]["id"]
    kept = upload(service, floor, walk_csv(2)).json()["survey"]["id"]
    service.run_jobs()
    jobs = service.row_counts()["job"]
    answer = upload(service, floor, walk_csv(3), replaces=old)
    assert answer.status_code == 202
    new = answer.json()["survey"]
    assert new["replaces"] == old
    assert service.row_counts()["job"] == jobs + 1
    assert service.http.get(f"/v1/surveys/{old}").status_code == 404
    assert sorted(surveys_of(service, floor)) == sorted([kept, new["id"]])
    again = upload(service, floor, walk_csv(3), replaces=old)
    assert (again.status_code, again.json()) == (200, answer.json())
    service.run_jobs()
    job = service.http.get(f"/v1/jobs/{answer.json()['job']['id']}").json()
    assert sorted(service.http.get(f"/v1/maps/{job['map_id']}").json()["survey_ids"]) == sorted([kept, new["id"]])
    assert upload(service, floor, walk_csv(3), replaces=new["id"]).status_code == 200, "by itself"


def test_a_replacement_with_a_key_is_answered_once(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor = new_floor(auto_build=False)
    old = upload(service, floor, walk_csv(1)).json()["survey"]["id"]
    asked = {"params": {"replaces": old}, "content": walk_csv(2), "headers": {"Idempotency-Key": f"replace-{old}"}}
    first, again = (service.http.post(f"/v1/floors/{floor}/surveys", **asked) for _ in range(2))
    assert (first.status_code, again.status_code) == (202, 202)
    assert first.json() == again.json()
    assert first.json()["job"] is None


def test_only_a_survey_of_the_same_floor_is_replaced(
    service: Any, new_floor: NewFloor, walk_csv: Walk, stranger: dict[str, str]
) -> None:
    floor, other = new_floor(), new_floor()
    old, there = (upload(service, each, walk_csv(1)).json()["survey"]["id"] for each in (floor, other))
    twin = upload(service, floor, walk_csv(2)).json()["survey"]["id"]
    before = service.row_counts(), service.blob_count()
    assert upload(service, floor, walk_csv(3), replaces="nobody").status_code == 404
    refused = upload(service, floor, walk_csv(3), replaces=there)
    assert refused.status_code == 422
    assert refused.json()["errors"][0]["location"] == "/query/replaces"
    foreign = service.http.post("/v1/buildings", json={"name": "Theirs"}, headers=stranger).json()["id"]
    path = f"/v1/buildings/{foreign}/floors"
    theirs = service.http.post(path, json={"name": "G", "ordinal": 0}, headers=stranger).json()["id"]
    answer = service.http.post(
        f"/v1/floors/{theirs}/surveys", params={"replaces": old}, content=walk_csv(3), headers=stranger
    )
    assert answer.status_code == 404
    assert service.blob_count() == before[1]
    assert upload(service, floor, walk_csv(2), replaces=old).status_code == 409, f"is {twin} already"
    assert sorted(surveys_of(service, floor)) == sorted([old, twin])


def test_a_change_names_the_rebuild_it_set_off(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor, quiet = new_floor(), new_floor(auto_build=False)
    first, second = (upload(service, floor, walk_csv(seed)).json()["survey"]["id"] for seed in (1, 2))
    patched = service.http.patch(f"/v1/surveys/{second}", json={"included": False}).json()
    assert patched["job"]["status"] == "accepted"
    assert patched["included"] is False
    assert service.http.patch(f"/v1/surveys/{second}", json={"included": False}).json()["job"] is None
    gone = service.http.delete(f"/v1/surveys/{second}")
    target = gone.headers["link"].removeprefix("<").removesuffix('>; rel="monitor"')
    assert service.http.get(target).json()["kind"] == "rebuild"
    assert "link" not in service.http.delete(f"/v1/surveys/{first}").headers, "nothing is left to build from"
    service.http.delete(target)
    only = upload(service, quiet, walk_csv(1)).json()["survey"]["id"]
    assert service.http.patch(f"/v1/surveys/{only}", json={"included": False}).json()["job"] is None
    assert "link" not in service.http.delete(f"/v1/surveys/{only}").headers


@pytest.mark.parametrize("encoding", ["gzip", "zstd"])
def test_compressed_bodies_are_the_same_survey(
    service: Any, new_floor: NewFloor, walk_csv: Walk, encoding: str
) -> None:
    floor, data = new_floor(), walk_csv(4)
    packed = gzip.compress(data) if encoding == "gzip" else zstandard.compress(data)
    first = service.http.post(f"/v1/floors/{floor}/surveys", content=packed, headers={"Content-Encoding": encoding})
    again = service.http.post(f"/v1/floors/{floor}/surveys", content=data)
    assert (first.status_code, again.status_code) == (202, 200)
    assert first.json()["survey"] == again.json()["survey"]


def test_packed_files_are_unpacked_without_being_told(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor, data = new_floor(), walk_csv(6)
    packed = [gzip.compress(data[:900]) + gzip.compress(data[900:]), zstandard.compress(data), data]
    answers = [service.http.post(f"/v1/floors/{floor}/surveys", content=each) for each in packed]
    assert [a.status_code for a in answers] == [202, 200, 200]


def test_a_zstd_stream_cut_at_a_line_is_not_half_a_survey(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor, data = new_floor(), walk_csv(6)
    half = data.rindex(b"\n", 0, len(data) // 2) + 1
    packer = zstandard.ZstdCompressor().compressobj()
    cut = packer.compress(data[:half]) + packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    answer = service.http.post(f"/v1/floors/{floor}/surveys", content=cut, headers={"Content-Encoding": "zstd"})
    assert answer.status_code == 422, answer.text
    assert service.http.get(f"/v1/floors/{floor}/surveys").json()["items"] == []


def test_racing_changes_of_a_survey_end_in_order(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor = new_floor(auto_build=False)
    survey = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1)).json()["survey"]["id"]
    statuses = []

    def change(k: int) -> None:
        url = f"/v1/surveys/{survey}"
        answer = service.http.delete(url) if k % 2 else service.http.patch(url, json={"included": k % 4 == 0})
        statuses.append(answer.status_code)

    threads = [threading.Thread(target=change, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(statuses) <= {200, 204, 404}, statuses
    assert statuses.count(204) == 1


def test_a_floor_whose_last_survey_goes_has_no_map(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor = new_floor()
    survey = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1)).json()["survey"]["id"]
    service.run_jobs()
    assert service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    service.http.delete(f"/v1/surveys/{survey}")
    assert service.http.get(f"/v1/floors/{floor}").json()["active_map_id"] is None


def test_a_rebuild_keeps_the_parameters_of_the_active_map(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor = new_floor()
    service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1))
    wanted = {"resolution_m": 0.5, "kernel": "squared_exponential"}
    assert service.http.post(f"/v1/floors/{floor}/maps", json=wanted).status_code == 202
    service.run_jobs()
    service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(2))
    service.run_jobs()
    active = service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    rebuilt = service.http.get(f"/v1/maps/{active}").json()
    assert (len(rebuilt["survey_ids"]), rebuilt["resolution_m"]) == (2, 0.5)
    assert rebuilt["hyperparameters"]["kernel"] == "squared_exponential"


def test_concurrent_uploads_of_the_same_bytes_make_one_survey(
    service: Any, new_floor: NewFloor, walk_csv: Walk
) -> None:
    floor, data, answers = new_floor(), walk_csv(5), []

    def upload() -> None:
        answers.append(service.http.post(f"/v1/floors/{floor}/surveys", content=data))

    threads = [threading.Thread(target=upload) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(a.status_code for a in answers) == [200] * 5 + [202], [a.text for a in answers]
    assert len({a.json()["survey"]["id"] for a in answers}) == 1
    assert len(service.http.get(f"/v1/floors/{floor}/surveys").json()["items"]) == 1


def _rows(*rows: str, header: str = HEADER) -> bytes:
    return ("\n".join([header, *rows]) + "\n").encode()


GOOD = ["0.0,0,0,1.2,20,1,-42", "0.1,0.1,0,1.2,20,1,-42", "0.2,0.2,0,1.2,20,1,-42"]
BAD_FILES = {
    "empty": (b"", ""),
    "header only": (_rows(), ""),
    "one sample": (_rows(GOOD[0]), ""),
    "missing column": (_rows("0,0,0,1.2,20,1", header="t_s,x_m,y_m,z_m,bx_ut,by_ut"), "bz_ut"),
    "short row": (_rows(*GOOD, "0.3,0,0"), "5"),
    "not a number": (_rows(*GOOD, "0.3,0,0,1.2,20,one,-42"), "by_ut"),
    "nan": (_rows(*GOOD, "0.3,0,0,1.2,nan,1,-42"), "bx_ut"),
    "infinity": (_rows(*GOOD, "0.3,inf,0,1.2,20,1,-42"), "x_m"),
    "time goes backwards": (_rows(*GOOD, "0.05,0,0,1.2,20,1,-42"), "t_s"),
    "nanotesla": (_rows(*[f"0.{i},0,0,1.2,20000,1000,-42000" for i in range(5)]), "nanotesla"),
    "gauss": (_rows(*[f"0.{i},0,0,1.2,0.2,0.01,-0.42" for i in range(5)]), "gauss"),
    "zero quaternion": (_rows(*[row + ",0,0,0,0" for row in GOOD], header=HEADER + ",qw,qx,qy,qz"), "q"),
    "not text": (b"\xff\xfe\x00\x01" * 50, ""),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_refused_with_where_and_why_and_nothing_is_stored(
    service: Any, mapped_floor: str, name: str
) -> None:
    data, said = BAD_FILES[name]
    before = service.row_counts(), service.blob_count()
    answer = service.http.post(f"/v1/floors/{mapped_floor}/surveys", content=data)
    assert answer.status_code == 422, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["type"].endswith("/unreadable-survey")
    assert problem["errors"], problem
    assert said in answer.text
    assert (service.row_counts(), service.blob_count()) == before


@pytest.mark.parametrize("format", ["parquet", "ndjson", "indoor-location-2020"])
@pytest.mark.parametrize("data", [b"", b"\x00\x01garbage", b"PAR1" + b"\x00" * 50 + b"PAR1", b'{"t_s": 1'])
def test_corrupt_files_of_other_formats_are_refused(service: Any, mapped_floor: str, format: str, data: bytes) -> None:
    before = service.row_counts(), service.blob_count()
    answer = service.http.post(f"/v1/floors/{mapped_floor}/surveys", params={"format": format}, content=data)
    assert answer.status_code == 422, answer.text
    assert (service.row_counts(), service.blob_count()) == before


@pytest.mark.parametrize(
    ("content", "headers", "status"),
    [
        (gzip.compress(b"0" * 2**22, mtime=0), {"Content-Encoding": "gzip"}, 413),
        (
            gzip.compress(b"0" * 2**21, mtime=0) + gzip.compress(b"0" * 2**21, mtime=0),
            {"Content-Encoding": "gzip"},
            413,
        ),
        (zstandard.compress(b"0" * 2**22), {"Content-Encoding": "zstd"}, 413),
        (b"0" * (2**21 + 1), {}, 413),
        (gzip.compress(b"hello", mtime=0)[:-6], {"Content-Encoding": "gzip"}, 422),
        (b"not gzip", {"Content-Encoding": "gzip"}, 422),
        (zstandard.compress(b"hello" * 100)[:-3], {"Content-Encoding": "zstd"}, 422),
        (zstandard.compress(b"hello" * 100_000)[:-3], {}, 422),
        (gzip.compress(b"0" * 2**22, mtime=0), {}, 413),
        (zlib.compress(b"hello"), {"Content-Encoding": "br"}, 422),
    ],
)
def test_bombs_and_damaged_streams_are_refused_and_nothing_is_stored(
    service: Any, mapped_floor: str, content: bytes, headers: dict[str, str], status: int
) -> None:
    before = service.row_counts(), service.blob_count()
    answer = service.http.post(f"/v1/floors/{mapped_floor}/surveys", content=content, headers=headers)
    assert answer.status_code == status, answer.text
    assert (service.row_counts(), service.blob_count()) == before


def test_an_upload_needs_a_floor_of_ones_own_and_the_scope(
    service: Any, mapped_floor: str, walk_csv: Walk, stranger: dict[str, str], key_with: Callable[..., dict[str, str]]
) -> None:
    reader, before = key_with("map:read"), None
    before = service.row_counts(), service.blob_count()
    path = f"/v1/floors/{mapped_floor}/surveys"
    assert service.http.post(path, content=walk_csv(9), headers=stranger).status_code == 404
    assert service.http.post(path, content=walk_csv(9), headers=reader).status_code == 403
    assert service.http.post(path, content=walk_csv(9), headers={"Authorization": "Bearer isd_no"}).status_code == 401
    assert service.http.post("/v1/floors/none/surveys", content=walk_csv(9)).status_code == 404
    assert (service.row_counts(), service.blob_count()) == before


def test_leaving_a_survey_out_and_deleting_it_set_off_rebuilds(
    service: Any, new_floor: NewFloor, walk_csv: Walk
) -> None:
    floor = new_floor()
    first, second = (
        service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(seed)).json()["survey"]["id"]
        for seed in (1, 2)
    )
    service.run_jobs()
    assert service.http.patch(f"/v1/surveys/{second}", json={"included": False}).json()["included"] is False
    service.run_jobs()
    active = service.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    alone = service.http.get(f"/v1/maps/{active}").json()
    assert alone["survey_ids"] == [first]
    assert alone["score"] is None
    assert alone["score_reason"]
    assert service.http.delete(f"/v1/surveys/{second}").status_code == 204
    assert service.http.get(f"/v1/surveys/{second}").status_code == 404
    service.run_jobs()


def test_a_floor_that_does_not_build_by_itself_has_no_job(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor = new_floor(auto_build=False)
    answer = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1))
    assert answer.status_code == 202
    assert answer.json()["job"] is None
    asked = service.http.post(f"/v1/floors/{floor}/maps", json={})
    assert asked.status_code == 202
    service.run_jobs()
    assert service.http.get(f"/v1/maps/{asked.json()['map']['id']}").json()["status"] == "ready"


def test_the_same_idempotency_key_gives_the_same_answer(service: Any, new_floor: NewFloor, walk_csv: Walk) -> None:
    floor, headers = new_floor(), {"Idempotency-Key": "walk-17"}
    first = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1), headers=headers)
    again = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1), headers=headers)
    other = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(2), headers=headers)
    assert (first.status_code, again.status_code, other.status_code) == (202, 202, 409)
    assert first.json() == again.json()
