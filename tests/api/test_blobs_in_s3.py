"""A whole journey with the bytes in S3: surveys, a map, positions; and what is said while the bucket is gone."""

from collections.abc import Callable, Iterator
from typing import Any
from uuid import uuid4

import numpy as np
import pytest

from app.blobs import S3BlobStore
from tests.s3_server import BUCKET, Server, Way

pytestmark = pytest.mark.s3


@pytest.fixture(scope="module")
def database_url(sqlite_url: str) -> str:
    return sqlite_url


@pytest.fixture(scope="module", autouse=True)
def way(s3: Server) -> Iterator[Way]:
    """Blobs are in S3, by a way that can be cut; before the service is made."""
    way = Way(s3.port)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", way.url)
        patch.setenv("ISODYN_BLOB_URL", f"s3://{BUCKET}/{uuid4().hex}")
        yield way
    way.close()


def window(true_field_uT: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> dict[str, Any]:
    """From (3, 2) along x, 20 readings."""
    x, y = 3.0 + 0.2 * np.arange(20), np.full(20, 2.0)
    return {
        "frame": "building",
        "b_ut": true_field_uT(x, y).tolist(),
        "noise_ut": 0.3,
        "displacement_m": np.column_stack([x - 3.0, y - 2.0, np.zeros(20)]).tolist(),
    }


def test_surveys_become_a_map_that_answers(
    service: Any, mapped_floor: str, active_map: str, true_field_uT: Callable[..., np.ndarray]
) -> None:
    assert isinstance(service.context.blobs, S3BlobStore)
    assert not (service.context.settings.data_dir / "blobs").exists()
    assert service.blob_count() >= 8
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": window(true_field_uT)})
    assert answer.status_code == 200, answer.text
    best = answer.json()["estimates"]["ml"]["position_m"]
    assert np.hypot(best[0] - 6.8, best[1] - 2.0) < 0.7, answer.text
    assert service.http.get(f"/v1/maps/{active_map}/quality").status_code == 200
    assert service.http.get("/readyz").json()["checks"]["blobs"] == "ok"


def test_without_the_bucket_503_and_nothing_is_recorded_and_later_all_is_well(
    service: Any, mapped_floor: str, active_map: str, walk_csv: Callable[..., bytes], way: Way
) -> None:
    rows, survey = service.row_counts(), walk_csv(9, offset_m=0.1)
    way.cut()
    for answer in (
        service.http.post(f"/v1/floors/{mapped_floor}/surveys", content=survey),
        service.http.get(f"/v1/maps/{active_map}/quality"),
    ):
        assert answer.status_code == 503, answer.text
        assert answer.headers["content-type"] == "application/problem+json"
        assert answer.json()["type"].endswith("/unavailable")
        assert int(answer.headers["retry-after"]) >= 1
        assert way.url not in answer.text
    ready = service.http.get("/readyz")
    assert (ready.status_code, ready.json()["checks"]["blobs"]) == (503, "Unavailable")
    assert service.row_counts() == rows
    way.mend()
    assert service.http.post(f"/v1/floors/{mapped_floor}/surveys", content=survey).status_code == 202
    service.run_jobs()
    assert service.http.get(f"/v1/floors/{mapped_floor}").json()["active_map_id"] != active_map


def test_a_server_that_dies_during_uploads_loses_none_that_was_acknowledged(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes], way: Way
) -> None:
    floor, acknowledged = new_floor(ordinal=7), []
    for seed, cut_after in enumerate((500, 30_000, 60_000, 90_000, 10**9)):
        way.cut()
        way.mend(cut_after)
        for again in range(2):
            answer = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(20 + 2 * seed + again))
            assert answer.status_code in (202, 503), answer.text
            acknowledged += [answer.json()["survey"]["id"]] if answer.status_code == 202 else []
    assert 0 < len(acknowledged) < 10
    listed = service.http.get(f"/v1/surveys?floor_id={floor}")
    for survey in acknowledged:
        assert service.http.get(f"/v1/surveys/{survey}/samples").status_code == 200, listed.text
