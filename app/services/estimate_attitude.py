"""An orientation from inertial and magnetic samples, against the reference that was asked for."""

from dataclasses import dataclass
from datetime import date
from typing import Any, Literal

import numpy as np
from sqlalchemy.orm import Session, sessionmaker

from app.attitude.mekf import AttitudeRun, begin, follow_attitude
from app.attitude.options import AttitudeOptions, InertialSamples
from app.attitude.reference import (
    MagneticReference,
    constant_reference,
    grid_reference,
    learned_reference,
    level_reference,
)
from app.db.tables import Floor
from app.earth_field import field_in_building_uT
from app.errors import Conflict, Fault, IncompatibleFrames, InvalidInput, NotFound
from app.field.grid import FieldGrid
from app.geometry import Array
from app.services.earth_reference import earth_at_building, told_model
from app.services.grid_cache import GridCache
from app.services.locate_window import active_maps
from app.services.reach import Reach

__all__ = [
    "AskedReference",
    "ReferenceKind",
    "check_vector",
    "earth_as_reference",
    "estimate_attitude",
    "find_reference",
]

ReferenceKind = Literal["none", "learned", "level", "wmm", "map_point", "map"]
STEEL_UT = 5.0  # sd per axis by which the field of a building departs from the Earth's


@dataclass(frozen=True, slots=True, eq=False)
class AskedReference:
    """What the magnetometer is compared with. `position_m` (1, 3) of map_point, (n, 3) of map, sd per axis."""

    kind: ReferenceKind
    building_id: str | None
    floor_id: str | None
    position_m: Array | None
    position_sd_m: float
    horizontal_uT: float | None
    vertical_uT: float | None
    on: date


def estimate_attitude(
    samples: InertialSamples, reference: MagneticReference | None, options: AttitudeOptions
) -> AttitudeRun:
    """What is known after every sample. Raises InvalidInput."""
    _, run = follow_attitude(begin(samples, reference, options), samples, reference, options)
    return run


def find_reference(
    sessions: sessionmaker[Session], grids: GridCache, reach: Reach, asked: AskedReference
) -> tuple[MagneticReference | None, dict[str, Any]]:
    """The reference, and what it was, as JSON. Raises NotFound, Conflict (no map), IncompatibleFrames, InvalidInput."""
    if asked.kind == "none":
        return None, {}
    if asked.kind == "learned":
        return learned_reference(), {}
    if asked.kind == "level":
        assert asked.horizontal_uT is not None
        assert asked.vertical_uT is not None
        told = {"horizontal_ut": asked.horizontal_uT, "vertical_ut": asked.vertical_uT}
        return level_reference(asked.horizontal_uT, asked.vertical_uT), told
    if asked.kind == "wmm":
        with sessions() as session:
            told = earth_as_reference(session, reach, asked.building_id, asked.floor_id, asked.on)
        return constant_reference(np.array(told["b_ut"]), told["sd_ut"]), told
    return _of_map(sessions, grids, reach, asked)


def earth_as_reference(
    session: Session, reach: Reach, building_id: str | None, floor_id: str | None, on: date
) -> dict[str, Any]:
    """The Earth's field in a building, or in that of a floor, as JSON: `b_ut` in its frame, and `sd_ut` per axis."""
    if building_id is None:
        floor = session.get(Floor, floor_id)
        if floor is None or not reach.holds(floor.organisation_id, floor.building_id):
            raise NotFound(f"no floor {floor_id}")
        building_id = floor.building_id
    field, anchor = earth_at_building(session, reach, building_id, on, "/body/reference/building_id")
    return told_model(field) | {"b_ut": field_in_building_uT(field, anchor).tolist(), "sd_ut": STEEL_UT}


def _of_map(
    sessions: sessionmaker[Session], grids: GridCache, reach: Reach, asked: AskedReference
) -> tuple[MagneticReference, dict[str, Any]]:
    assert asked.floor_id is not None
    assert asked.position_m is not None
    with sessions() as session:
        maps = active_maps(session.connection(), reach, floor_ids=[asked.floor_id])
    if not maps:
        raise Conflict(f"floor {asked.floor_id} has no map yet; upload surveys and wait for its job")
    grid = grids.grid(maps[0].grid_sha256)
    check_vector(grid)
    told: dict[str, Any] = {"floor_id": asked.floor_id, "map_id": maps[0].map_id}
    if asked.kind == "map_point":
        values = grid.at(asked.position_m)
        if not values.measured[0]:
            reason = "nothing is mapped at this point"
            raise InvalidInput(reason, Fault("/body/reference/position_m", reason))
        wander = grid.prior_sd_uT  # the field where the device is differs from that of the point by as much
        told |= {"b_ut": values.mean_uT[0].tolist(), "sd_ut": wander.tolist()}
        return MagneticReference(values.mean_uT[0], np.square(wander)), told
    reference = grid_reference(grid, asked.position_m, asked.position_sd_m**2 * np.eye(2))
    assert reference.B_uT is not None
    return reference, told | {"mapped_share": float(np.isfinite(reference.B_uT).all(axis=1).mean())}


def check_vector(grid: FieldGrid) -> None:
    """Raises IncompatibleFrames for a map that does not tell the field's direction."""
    if grid.components != "vector":
        raise IncompatibleFrames(
            f"a {grid.components} map does not tell the field's direction; survey the floor with orientation"
        )
