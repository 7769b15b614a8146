"""The Earth's field over HTTP, and surveys checked against it."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

ANN_ARBOR = {"latitude_deg": 42.294431, "longitude_deg": -83.710442, "height_m": 236.0}


@pytest.fixture(scope="module")
def database_url(sqlite_url: str) -> str:
    """The database is asked for rows by their ids alone, as in test_calibrations, which runs on both kinds."""
    return sqlite_url


def test_by_place_and_date(service: Any) -> None:
    told = service.http.get("/v1/reference-field", params=ANN_ARBOR | {"date": "2022-09-01"}).json()
    assert told["magnitude_ut"] == pytest.approx(53.1351, abs=5e-5)
    assert told["declination_deg"] == pytest.approx(-7.052, abs=1e-3)
    assert told["inclination_deg"] == pytest.approx(68.72, abs=0.01)
    assert (told["model"], told["valid"], told["building_ut"]) == ("WMM-2020", True, None)
    today = service.http.get("/v1/reference-field", params=ANN_ARBOR).json()
    assert today["model"] == "WMM-2025"
    late = service.http.get("/v1/reference-field", params=ANN_ARBOR | {"date": "2040-01-01"}).json()
    assert not late["valid"]


def test_at_a_buildings_anchor_in_its_own_frame(service: Any) -> None:
    anchor = ANN_ARBOR | {"bearing_deg": 90.0}
    building = service.http.post("/v1/buildings", json={"name": "Anchored", "anchor": anchor}).json()["id"]
    told = service.http.get("/v1/reference-field", params={"building_id": building, "date": "2022-09-01"}).json()
    # +x points east, so that y points north
    np.testing.assert_allclose(told["building_ut"], [told["east_ut"], told["north_ut"], -told["down_ut"]])


def test_refusals(service: Any, building: str, stranger: dict[str, str]) -> None:
    for asked, said in (
        ({}, "latitude_deg"), ({"latitude_deg": 1}, "longitude_deg"), ({"building_id": building}, "no anchor"),
        ({"building_id": building, "latitude_deg": 1}, "not both"), (ANN_ARBOR | {"date": "2005-01-01"}, "2010"),
    ):  # fmt: skip
        answer = service.http.get("/v1/reference-field", params=asked)
        assert answer.status_code == 422, answer.text
        assert said in answer.json()["detail"]
    assert (
        service.http.get("/v1/reference-field", params={"building_id": building}, headers=stranger).status_code == 404
    )


def test_a_survey_upside_down_is_told_so(service: Any, walk_csv: Callable[..., bytes]) -> None:
    # the walks' mean field, (18, 3, -42) uT: dipping 66 degrees, near that of Ann Arbor seen from +x to the north
    anchor = ANN_ARBOR | {"bearing_deg": 2.0}
    building = service.http.post("/v1/buildings", json={"name": "Checked", "anchor": anchor}).json()["id"]
    floor = service.http.post(f"/v1/buildings/{building}/floors", json={"name": "G", "ordinal": 0, "elevation_m": 0,
                                                                        "auto_build": False}).json()["id"]  # fmt: skip
    right = walk_csv(1)
    lines = right.decode().splitlines()
    turned = [lines[0], *(
        ",".join([*line.split(",")[:5], *(str(-float(v)) for v in line.split(",")[5:])]) for line in lines[1:]
    )]  # fmt: skip
    found = []
    for data in (right, "\n".join(turned).encode()):
        survey = service.http.post(f"/v1/floors/{floor}/surveys", content=data).json()["survey"]["id"]
        report = service.http.get(f"/v1/surveys/{survey}/report").json()
        assert report["reference_field"]["model"] == "WMM-2025"
        assert set(report["reference_field"]["findings"]) <= set(report["warnings"])
        found.append(report["reference_field"]["findings"])
    assert found[0] == []
    assert len(found[1]) == 1
    assert "z looks inverted" in found[1][0]
    assert "negate y and z" in found[1][0]


def test_without_an_anchor_nothing_is_said(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]
) -> None:
    floor = new_floor(auto_build=False)
    survey = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(3)).json()["survey"]["id"]
    assert service.http.get(f"/v1/surveys/{survey}/report").json()["reference_field"] is None
