"""Calibrate a device: what it was turned or walked in, the method, and the result with what it was measured against."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation
from sqlalchemy.orm import Session, sessionmaker

from app.calibration.coverage import refusal
from app.calibration.ellipsoid import ellipsoid
from app.calibration.fit import CalibrationFit
from app.calibration.map_aided import map_aided
from app.calibration.modified_ellipsoid import modified_ellipsoid
from app.calibration.strict_ellipse import strict_ellipse
from app.calibration.swinging import swinging
from app.calibration.two_step import two_step
from app.earth_field import EarthField, earth_field
from app.errors import Conflict, Fault, InvalidInput
from app.field.grid import FieldGrid
from app.geometry import Array, path_length_m
from app.positioning.window import Window
from app.services.calibrate_on_map import calibrate_on_map
from app.services.earth_reference import earth_at_building, told_model
from app.services.estimate_attitude import check_vector
from app.services.grid_cache import GridCache
from app.services.locate_window import active_maps
from app.services.reach import Reach

__all__ = ["CIRCLE_METHODS", "Asked", "MappedWalk", "Place", "calibrate"]

CIRCLE_METHODS = ("modified_ellipsoid", "strict_ellipse", "swinging")
"""Those for a device that is turned level; the others need it turned through all directions."""

_CIRCLES = {"modified_ellipsoid": modified_ellipsoid, "strict_ellipse": strict_ellipse, "swinging": swinging}
_SPHERES = {"ellipsoid": ellipsoid, "two_step": two_step}
LEAST_MAPPED = 30
NEARLY_UNIT = 0.1
NOISE_UT = 0.5


@dataclass(frozen=True, slots=True)
class Place:
    """Where readings were taken outdoors: a building's anchor, or a latitude and longitude."""

    building_id: str | None
    latitude_deg: float | None
    longitude_deg: float | None
    height_m: float
    on: date
    z_axis: Literal["up", "down"]


@dataclass(frozen=True, slots=True, eq=False)
class MappedWalk:
    """A walk through a mapped building, on one floor or on any of a building.

    known    whether the way (n, 3) is positions in the building, and q (n, 4) turns the sensor's axes to it; else both
             are of the level frame of the first reading, and the map has to find where that was
    """

    floor_id: str | None
    building_id: str | None
    q: Array
    way_m: Array
    known: bool
    position_sd_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """A calibration that is asked for: readings (n, 3) in the sensor's axes, and what they are measured against."""

    method: str
    B_uT: Array
    magnitude_uT: float | None
    horizontal_uT: float | None
    vertical_uT: float | None
    place: Place | None
    walk: MappedWalk | None


def calibrate(
    sessions: sessionmaker[Session], grids: GridCache, reach: Reach, asked: Asked
) -> tuple[CalibrationFit, dict[str, Any], Mapping[str, Array]]:
    """The fit, the reference as JSON, and the arrays it was made from.

    Raises InvalidInput with advice where the readings do not determine it, NotFound, Conflict (no map yet).
    """
    try:
        if asked.walk is not None:
            return _on_a_map(sessions, grids, reach, asked, asked.walk)
        return _by_turning(sessions, reach, asked)
    except np.linalg.LinAlgError:  # of readings that no check foresaw
        raise refusal("The readings do not determine a calibration", []) from None


def _by_turning(
    sessions: sessionmaker[Session], reach: Reach, asked: Asked
) -> tuple[CalibrationFit, dict[str, Any], Mapping[str, Array]]:
    earth = None if asked.place is None else _earth(sessions, reach, asked.place)
    readings = {"b_ut": asked.B_uT}
    told: dict[str, Any] = {} if earth is None else told_model(earth)
    if asked.method in CIRCLE_METHODS:
        horizontal, vertical = asked.horizontal_uT, asked.vertical_uT
        if earth is not None:
            assert asked.place is not None
            horizontal = horizontal or earth.horizontal_uT
            down = earth.down_uT if asked.place.z_axis == "down" else -earth.down_uT
            vertical = down if vertical is None else vertical
        assert horizontal is not None
        assert vertical is not None
        fit = _CIRCLES[asked.method](asked.B_uT, horizontal, vertical)
        return fit, told | {"horizontal_ut": horizontal, "vertical_ut": vertical}, readings
    magnitude = asked.magnitude_uT
    if earth is not None:
        magnitude = magnitude or earth.magnitude_uT
    assert magnitude is not None
    return _SPHERES[asked.method](asked.B_uT, magnitude), told | {"magnitude_ut": magnitude}, readings


def _earth(sessions: sessionmaker[Session], reach: Reach, place: Place) -> EarthField:
    if place.building_id is None:
        assert place.latitude_deg is not None
        assert place.longitude_deg is not None
        return earth_field(place.latitude_deg, place.longitude_deg, place.height_m, place.on)
    with sessions() as session:
        field, _ = earth_at_building(
            session, reach, place.building_id, place.on, "/body/reference/building_id"
        )  # fmt: skip
    return field


def _on_a_map(
    sessions: sessionmaker[Session], grids: GridCache, reach: Reach, asked: Asked, walk: MappedWalk
) -> tuple[CalibrationFit, dict[str, Any], Mapping[str, Array]]:
    _check_unit(walk.q)
    with sessions() as session:
        maps = active_maps(
            session.connection(), reach, building_id=walk.building_id,
            floor_ids=None if walk.floor_id is None else [walk.floor_id],
        )  # fmt: skip
    if not maps:
        where = f"building {walk.building_id}" if walk.floor_id is None else f"floor {walk.floor_id}"
        raise Conflict(f"{where} has no map yet; upload surveys and wait for its job")
    readings = {"b_ut": asked.B_uT, "orientation": walk.q, "way_m": walk.way_m}
    rotation = Rotation.from_quat(walk.q, scalar_first=True).as_matrix()
    if walk.known:
        fit, reference = _along(grids.grid(maps[0].grid_sha256), asked.B_uT, rotation, walk)
        return fit, reference | {"floor_id": maps[0].floor_id, "map_id": maps[0].map_id}, readings
    window = Window(
        frame="level", B_uT=np.einsum("nij,nj->ni", rotation, asked.B_uT), displacement_m=walk.way_m - walk.way_m[0],
        noise_uT=NOISE_UT,
        device_to_frame=rotation,
    )  # fmt: skip
    for each in maps:
        check_vector(grids.grid(each.grid_sha256))
    found = calibrate_on_map(window, grids.searchable([(each.floor_id, each.grid_sha256) for each in maps]))
    if found.fix.status != "fix":
        reason = f"where the walk went is not found: {found.fix.reason or found.fix.status}"
        raise InvalidInput(
            f"{reason}; walk farther, with turns, where surveyors walked", Fault("/body/walk/displacement_m", reason)
        )
    here = next(each for each in maps if each.floor_id == found.floor_id)
    told = {"floor_id": here.floor_id, "map_id": here.map_id, "ended_at_m": found.way.position_m[-1].tolist()}
    return found.fit, told, readings


def _along(grid: FieldGrid, B_uT: Array, rotation: Array, walk: MappedWalk) -> tuple[CalibrationFit, dict[str, Any]]:
    """By positions that were told, where the map has measured."""
    check_vector(grid)
    values = grid.at(walk.way_m)
    kept = values.measured
    if kept.sum() < LEAST_MAPPED:
        reason = f"{int(kept.sum())} of {len(kept)} readings were taken where the floor is mapped"
        raise InvalidInput(
            f"{reason}, {LEAST_MAPPED} are needed; walk where surveyors walked", Fault("/body/walk/position_m", reason)
        )
    slope = values.gradient_uT_per_m[kept][:, :, :2]
    fit = map_aided(
        B_uT[kept],
        rotation[kept],
        values.mean_uT[kept],
        values.sd_uT[kept] ** 2 + walk.position_sd_m**2 * (slope**2).sum(axis=2),
        path_m=path_length_m(walk.way_m[kept]),
    )
    return fit, {"position_sd_m": walk.position_sd_m, "mapped_readings": int(kept.sum())}


def _check_unit(q: Array) -> None:
    wrong = np.abs(np.linalg.norm(q, axis=1) - 1.0) > NEARLY_UNIT
    if wrong.any():
        at = int(np.argmax(wrong))
        reason = f"its norm is {np.linalg.norm(q[at]):.3g}, not 1"
        raise InvalidInput(f"orientation {at} is no unit quaternion", Fault(f"/body/walk/orientation/{at}", reason))
