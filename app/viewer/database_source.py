"""The viewer's source on the real storage: rows by SQLAlchemy, grids and samples by their hash in the blob store."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import BlobStore
from app.db.tables import Building, Floor, Map, Survey
from app.errors import NotFound
from app.field.samples import Samples
from app.geometry import Array
from app.services.artefacts import grid_from_bytes, layers_from_bytes, samples_from_bytes
from app.services.reach import Reach
from app.viewer.source import PlacedPlan, ViewedBuilding, ViewedFloor, ViewedMap, Walk

__all__ = ["DatabaseViewerSource", "rings_of_polygon"]

_MOST_SAMPLES = 5_000  # of a walk: at a walking pace one every few centimetres


class DatabaseViewerSource:
    """A `ViewerSource`: every statement asks for rows within reach."""

    def __init__(self, sessions: sessionmaker[Session], blobs: BlobStore) -> None:
        self._sessions = sessions
        self._blobs = blobs

    def buildings(self, reach: Reach) -> list[ViewedBuilding]:
        """Every building by name with its floors from the lowest, in two statements."""
        floors_of: dict[str, list[ViewedFloor]] = {}
        with self._sessions() as session:
            rows = session.execute(
                select(Floor, Map.grid_sha256)
                .outerjoin(Map, (Map.id == Floor.active_map_id) & (Map.status == "ready"))
                .where(Floor.organisation_id == reach.organisation_id)
                .order_by(Floor.ordinal, Floor.id)
            )
            for floor, grid_sha256 in rows:
                floors_of.setdefault(floor.building_id, []).append(_viewed(floor, grid_sha256))
            buildings = session.scalars(
                select(Building)
                .where(Building.organisation_id == reach.organisation_id)
                .order_by(Building.name, Building.id)
            )
            within = [b for b in buildings if reach.holds(b.organisation_id, b.id)]
            return [ViewedBuilding(b.id, b.name, tuple(floors_of.get(b.id, ()))) for b in within]

    def map(self, reach: Reach, map_id: str) -> ViewedMap:
        """A map that is ready, with what is stored beside its grid. Raises NotFound, CorruptArtefact."""
        with self._sessions() as session:
            row = session.execute(
                select(Map.floor_id, Map.grid_sha256, Map.layers_sha256, Floor.organisation_id, Floor.building_id)
                .join(Floor, Floor.id == Map.floor_id)
                .where(Map.id == map_id, Map.grid_sha256.is_not(None))
            ).one_or_none()
        if row is None or not reach.holds(row.organisation_id, row.building_id):
            raise NotFound(f"no map {map_id} that is ready; `GET /v1/maps/{map_id}` says how it stands")
        stored = {} if row.layers_sha256 is None else layers_from_bytes(self._blobs.get(row.layers_sha256))
        return ViewedMap(row.floor_id, grid_from_bytes(self._blobs.get(row.grid_sha256)), stored)

    def walks(self, reach: Reach, floor_id: str, known: Mapping[str, Walk]) -> list[Walk]:
        """The included surveys of a floor in order of arrival. Raises NotFound, CorruptArtefact."""
        with self._sessions() as session:
            _find_floor(session, reach, floor_id)
            rows = session.execute(
                select(Survey.id, Survey.name, Survey.samples_sha256)
                .where(Survey.floor_id == floor_id, Survey.included)
                .order_by(Survey.id)
            ).all()
        return [known.get(row[0]) or self._walk(*row) for row in rows]

    def plan_image(self, reach: Reach, floor_id: str) -> bytes:
        """The picture of a floor's plan. Raises NotFound, CorruptArtefact."""
        with self._sessions() as session:
            plan = _find_floor(session, reach, floor_id).plan
        if plan is None:
            raise NotFound(f"floor {floor_id} has no plan; `PUT /v1/floors/{floor_id}/plan` gives it one")
        return self._blobs.get(plan["sha256"])

    def _walk(self, survey_id: str, name: str, samples_sha256: str) -> Walk:
        samples = samples_from_bytes(self._blobs.get(samples_sha256))
        kept = slice(None, None, -(-len(samples) // _MOST_SAMPLES))
        thinned = Samples(samples.t_s[kept], samples.p_building_m[kept], samples.B_uT[kept], samples.frame)
        return Walk(survey_id, name, thinned)


def _find_floor(session: Session, reach: Reach, floor_id: str) -> Floor:
    floor = session.get(Floor, floor_id)
    if floor is None or not reach.holds(floor.organisation_id, floor.building_id):
        raise NotFound(f"no floor {floor_id}; `GET /v1/buildings` shows what there is")
    return floor


def _viewed(floor: Floor, grid_sha256: str | None) -> ViewedFloor:
    return ViewedFloor(
        id=floor.id,
        name=floor.name,
        ordinal=floor.ordinal,
        elevation_m=floor.elevation_m,
        rings_m=rings_of_polygon(floor.outline),
        map_id=floor.active_map_id if grid_sha256 is not None else None,
        grid_sha256=grid_sha256,
        plan=_placed(floor.plan),
    )


def _placed(plan: dict[str, Any] | None) -> PlacedPlan | None:
    return None if plan is None else PlacedPlan(**{name: plan[name] for name in PlacedPlan.__dataclass_fields__})


def rings_of_polygon(outline: dict[str, Any] | None) -> tuple[Array, ...]:
    """The rings (k, 2) of a GeoJSON Polygon, or of every polygon of a MultiPolygon, in building metres; () for None."""
    if outline is None:
        return ()
    polygons = outline["coordinates"] if outline["type"] == "MultiPolygon" else [outline["coordinates"]]
    return tuple(np.asarray(ring, dtype=np.float64)[:, :2] for rings in polygons for ring in rings)
