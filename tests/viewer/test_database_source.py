"""The viewer's source on a real database and a real blob store."""

from hashlib import sha256

import numpy as np
import pytest

from app.blobs import FolderBlobStore
from app.db.engine import create_database_engine, session_factory
from app.db.tables import Base, Building, Floor, Map, Organisation, Survey
from app.errors import NotFound
from app.field.samples import Samples
from app.services.artefacts import grid_to_bytes, samples_to_bytes
from app.services.reach import Reach
from app.viewer.database_source import DatabaseViewerSource, rings_of_polygon
from app.viewer.source import PlacedPlan

PLAN = {
    "media_type": "image/png", "width_px": 300, "height_px": 200, "metres_per_pixel": 0.03, "width_m": 9.0,
    "height_m": 6.0, "x_m": -1.0, "y_m": 2.0, "bearing_rad": 0.5,
}  # fmt: skip
OUTLINE = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 5], [0, 5], [0, 0]]]}


@pytest.fixture
def storage(tmp_path, grid_of, walk_of):
    engine = create_database_engine(f"sqlite:///{tmp_path / 'test.db'}")
    Base.metadata.create_all(engine)
    sessions, blobs = session_factory(engine), FolderBlobStore(tmp_path / "blobs")
    walk = walk_of("a")
    samples = Samples(np.arange(200.0), walk.p_building_m, walk.samples.B_uT, "building")
    grid_sha256, samples_sha256 = blobs.put(grid_to_bytes(grid_of())), blobs.put(samples_to_bytes(samples))
    plan_sha256 = blobs.put(b"a picture")
    with sessions.begin() as session:
        for organisation in ("north", "south"):
            session.add(Organisation(id=organisation, name=organisation))
            session.flush()
            session.add(Building(id=f"b-{organisation}", organisation_id=organisation, name=f"House {organisation}"))
            session.flush()
            for ordinal, name in ((1, "First"), (0, "Ground")):
                session.add(
                    Floor(
                        id=f"f{ordinal}-{organisation}", organisation_id=organisation,
                        building_id=f"b-{organisation}", name=name, ordinal=ordinal, elevation_m=4.0 * ordinal,
                        outline=OUTLINE if ordinal == 0 else None,
                        plan=PLAN | {"sha256": plan_sha256} if ordinal == 0 else None,
                        active_map_id=f"m-{organisation}" if ordinal == 0 else None,
                    )
                )  # fmt: skip
            session.flush()
            session.add(
                Map(
                    id=f"m-{organisation}", organisation_id=organisation, floor_id=f"f0-{organisation}",
                    status="ready", spec={}, survey_ids=[], grid_sha256=grid_sha256,
                )
            )  # fmt: skip
            for number, included in enumerate((True, False)):
                session.add(
                    Survey(
                        id=f"s{number}-{organisation}", organisation_id=organisation, floor_id=f"f0-{organisation}",
                        name=f"walk {number}", format="csv", frame="building", raw_sha256=f"{number}" * 64,
                        samples_sha256=samples_sha256, sample_count=200, report={}, included=included,
                    )
                )  # fmt: skip
    yield sessions, DatabaseViewerSource(sessions, blobs)
    engine.dispose()


def test_buildings_come_with_their_floors_from_the_lowest(storage):
    _, source = storage
    (building,) = source.buildings(Reach("north"))
    assert building.name == "House north"
    assert [f.name for f in building.floors] == ["Ground", "First"]
    ground, first = building.floors
    assert (ground.map_id, first.map_id) == ("m-north", None)
    assert len(ground.grid_sha256) == 64
    np.testing.assert_array_equal(ground.rings_m[0], OUTLINE["coordinates"][0])
    assert first.rings_m == ()
    assert first.elevation_m == 4.0
    assert source.buildings(Reach("nobody")) == []


def test_a_map_that_is_not_ready_is_not_offered(storage):
    sessions, source = storage
    with sessions.begin() as session:
        row = session.get_one(Map, "m-north")
        row.status, row.grid_sha256 = "running", None
    assert source.buildings(Reach("north"))[0].floors[0].map_id is None
    with pytest.raises(NotFound):
        source.map(Reach("north"), "m-north")


def test_the_grid_and_the_included_walks_are_those_stored(storage, grid_of, walk_of):
    _, source = storage
    np.testing.assert_array_equal(source.map(Reach("north"), "m-north").grid.mean_uT, grid_of().mean_uT)
    assert source.map(Reach("north"), "m-north").floor_id == "f0-north"
    (walk,) = source.walks(Reach("north"), "f0-north", {})
    assert (walk.survey_id, walk.name) == ("s0-north", "walk 0")
    np.testing.assert_array_equal(walk.p_building_m, walk_of("a").p_building_m)
    assert source.walks(Reach("north"), "f0-north", {walk.survey_id: walk}) == [walk]  # not read again
    assert source.walks(Reach("north"), "f1-north", {}) == []


def test_a_reach_of_other_buildings_finds_nothing(storage):
    _, source = storage
    elsewhere = Reach("north", frozenset({"b-south", "b-elsewhere"}))
    assert source.buildings(elsewhere) == []
    assert [each.id for each in source.buildings(Reach("north", frozenset({"b-north"})))] == ["b-north"]
    for ask in (lambda: source.map(elsewhere, "m-north"), lambda: source.walks(elsewhere, "f0-north", {}),
                lambda: source.plan_image(elsewhere, "f0-north")):  # fmt: skip
        with pytest.raises(NotFound):
            ask()


def test_another_organisations_objects_are_not_found(storage):
    _, source = storage
    with pytest.raises(NotFound):
        source.map(Reach("north"), "m-south")
    with pytest.raises(NotFound):
        source.walks(Reach("north"), "f0-south", {})
    with pytest.raises(NotFound):
        source.walks(Reach("north"), "no-such-floor", {})
    with pytest.raises(NotFound):
        source.plan_image(Reach("north"), "f0-south")


def test_a_floor_has_its_plan_and_where_it_lies(storage):
    _, source = storage
    ground, first = source.buildings(Reach("north"))[0].floors
    assert ground.plan == PlacedPlan(sha256(b"a picture").hexdigest(), 9.0, 6.0, -1.0, 2.0, 0.5)
    assert first.plan is None
    assert source.plan_image(Reach("north"), ground.id) == b"a picture"
    for floor in (first.id, "f0-south"):
        with pytest.raises(NotFound):
            source.plan_image(Reach("north"), floor)


def test_every_ring_of_every_polygon_is_drawn():
    rings = [[[0, 0], [9, 0], [9, 5], [0, 0]], [[1, 1], [2, 1], [2, 2], [1, 1]], [[20, 0], [29, 0], [29, 5], [20, 0]]]
    outline = {"type": "MultiPolygon", "coordinates": [rings[:2], rings[2:]]}
    assert [ring.tolist() for ring in rings_of_polygon(outline)] == rings
