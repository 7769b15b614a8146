"""Calibrate a phone by walking through a mapped building, without being told where.

The turns of a walk tell the sensor's offset roughly, whatever the building. A search that integrates the rest of it out
finds where the walk went; the map along that way then tells what the sensor makes of the field, and with the sensor
known the way is found better. Two or three rounds settle it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from app.calibration.fit import CalibrationFit
from app.calibration.map_aided import map_aided
from app.calibration.sensor_model import SensorModel
from app.errors import Fault, InvalidInput
from app.field.grid import FieldGrid
from app.geometry import Array, path_length_m, yaw_matrix
from app.positioning.explanation import ExplainedPlace
from app.positioning.fix import Fix, LocateOptions
from app.positioning.locate import SearchableFloor, locate_and_explain
from app.positioning.window import Window

__all__ = [
    "CalibratedOnMap", "Way", "calibrate_on_map", "calibrate_along", "offset_by_turns", "way_of", "with_sensor",
]  # fmt: skip

ROUNDS = 3
LEFT_UT = 1.0
"""Sd of the offset a calibrated sensor still has, in the searches after the first."""
SHAPE_SD_M = 0.3
"""Sd of where a sample lies on a way that as a whole is right: steps are uneven, and turns err."""
DISTORTED = 2.0
"""Sds of the distortion, times the horizontal field, that the first search takes for noise: it changes as the device
turns, alike over a whole leg; with less, a walk off the map explains it better than the right one.
"""
SPACING_M = 1.0
"""Samples of the first search are this far apart: what an unknown distortion does is no noise that a mean would lessen.
"""
EARTH_UT, STEEL_UT, STEEL_M = 20.0, 5.0, 3.0
"""Sds of the horizontal field in an unknown direction and of what a building's steel adds, and how far that goes on."""
LEAST_SHARE = 0.5
"""Of the walk that must be where something is mapped."""


@dataclass(frozen=True, slots=True, eq=False)
class Way:
    """Where each sample of a window was: position_m (n, 2), rotation (n, 3, 3) from the sensor's axes to the
    building's, covariance_m2 (2, 2) of a position, path_m (n,) walked."""

    position_m: Array
    rotation: Array
    covariance_m2: Array
    path_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedOnMap:
    """The sensor, the walk as it reads when corrected and where it went on which floor, and the fix it ended in."""

    fit: CalibrationFit
    corrected: Window
    way: Way
    floor_id: str
    fix: Fix


def calibrate_on_map(
    window: Window,
    floors: Sequence[SearchableFloor],
    *,
    hard_iron_sd_uT: float = 30.0,
    soft_iron_sd: float = 0.1,
    options: LocateOptions | None = None,
    rounds: int = ROUNDS,
) -> CalibratedOnMap:
    """From a level window over a whole walk, its last 40-100 m best, told how the device was turned at every sample.

    Needs `yaw_rad` (the device then is taken to be level) or `device_to_frame`. The calibration is in the device's
    axes; it is only good if `fix.status` is "fix". Raises InvalidInput where the walk is mostly off the map.
    """
    options = options or LocateOptions()
    if options.walkable is None:  # off the map a walk is explained well by any sensor, and tells nothing of it
        options = replace(options, walkable=partial(_mapped, {floor.floor_id: floor.grid for floor in floors}))
    turn = _device_to_frame(window)
    window = replace(window, yaw_rad=_device_yaw_rad(turn))  # so that the heading found is the device's
    distorted_uT = DISTORTED * soft_iron_sd * _turning_uT(turn, floors)
    vertical_uT = float(np.median([floor.grid.ambient_uT[2] for floor in floors]))
    offset_uT, bias_sd_uT = offset_by_turns(window, turn, vertical_uT, hard_iron_sd_uT)
    asked = replace(
        _thinned(with_sensor(window, turn, SensorModel(offset_uT, np.eye(3)))),
        noise_uT=float(np.hypot(window.noise_uT, distorted_uT)),
    )
    for _ in range(rounds):
        fix, explained = locate_and_explain(asked, floors, options=replace(options, bias_sd_uT=bias_sd_uT))
        if explained is None or fix.posterior is None:
            raise InvalidInput("There is no map to calibrate on.", Fault("floors", "none has a map"))
        place = explained.best
        floor = next(each for each in floors if each.floor_id == place.floor_id)
        way = way_of(window, turn, place, fix.posterior.covariance_m2)
        fit = calibrate_along(window, turn, way, floor.grid, hard_iron_sd_uT=hard_iron_sd_uT, soft_iron_sd=soft_iron_sd)
        asked, bias_sd_uT = with_sensor(window, turn, fit.model), LEFT_UT
    return CalibratedOnMap(fit, asked, way, place.floor_id, fix)


def offset_by_turns(
    window: Window, device_to_frame: Array, vertical_uT: float, hard_iron_sd_uT: float
) -> tuple[Array, float]:
    """A first hard iron (3,) uT, with the largest sd it has in any direction, from the turns of a walk alone.

    Of readings turned to the frame, a field that is constant but for what steel does stays, and the sensor's offset
    goes round: least squares tells them apart, where the device turned. The vertical is taken to be the map's.
    """
    y = np.asarray(window.B_uT, dtype=np.float64).ravel()
    design = np.concatenate([np.broadcast_to(np.eye(3), device_to_frame.shape), device_to_frame], axis=2).reshape(-1, 6)
    walked_m = float(path_length_m(np.asarray(window.displacement_m, dtype=np.float64))[-1])
    independent = max(1.0, walked_m / STEEL_M) / len(window.B_uT)
    prior_sd = np.array([EARTH_UT, EARTH_UT, STEEL_UT, *np.full(3, hard_iron_sd_uT)])
    covariance = np.linalg.inv(design.T @ design * independent / STEEL_UT**2 + np.diag(prior_sd**-2.0))
    mean = np.array([0.0, 0.0, vertical_uT, 0.0, 0.0, 0.0])
    right = design.T @ (y - design @ mean) * independent / STEEL_UT**2
    found = covariance @ right
    return np.asarray(found[3:]), float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))


def _device_yaw_rad(device_to_frame: Array) -> Array:
    """(n,) of the device's x axis in the window's frame."""
    return np.asarray(np.arctan2(device_to_frame[:, 1, 0], device_to_frame[:, 0, 0]))


def _mapped(grids: Mapping[str, FieldGrid], floor_id: str, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
    """(ny, nx) which places of a floor are mapped."""
    x, y = np.meshgrid(x_m, y_m)
    return grids[floor_id].at(np.column_stack([x.ravel(), y.ravel()])).measured.reshape(x.shape)


def _turning_uT(device_to_frame: Array, floors: Sequence[SearchableFloor]) -> float:
    """By how much the ambient field moves in the device's axes as it is turned: that much of it a distortion spoils."""
    ambient_uT = np.median([floor.grid.ambient_uT for floor in floors], axis=0)
    level_uT = np.array([np.hypot(ambient_uT[0], ambient_uT[1]), 0.0, ambient_uT[2]])
    body_uT = np.einsum("nji,j->ni", device_to_frame, level_uT)
    return float(np.sqrt(np.sum(np.var(body_uT, axis=0))))


def calibrate_along(
    window: Window, device_to_frame: Array, way: Way, grid: FieldGrid, *, hard_iron_sd_uT: float, soft_iron_sd: float
) -> CalibrationFit:
    """The calibration of a window whose way is known, with what the map and the way do not know."""
    field = grid.at(way.position_m)
    on_map = field.measured
    if on_map.mean() < LEAST_SHARE:
        message = f"Only {100 * on_map.mean():.0f} % of the walk is where something is mapped: walk where the map is."
        raise InvalidInput(message, Fault("window", "mostly off the map"))
    J = field.gradient_uT_per_m
    moved_uT2 = np.einsum("nci,ij,ncj->nc", J, way.covariance_m2, J, optimize=True)
    body = np.einsum("nji,nj->ni", device_to_frame, window.B_uT)
    return map_aided(
        body[on_map], way.rotation[on_map], field.mean_uT[on_map], (field.sd_uT**2 + moved_uT2)[on_map],
        path_m=way.path_m[on_map], noise_uT=window.noise_uT, hard_iron_sd_uT=hard_iron_sd_uT, soft_iron_sd=soft_iron_sd,
    )  # fmt: skip


def way_of(window: Window, device_to_frame: Array, place: ExplainedPlace, covariance_m2: Array) -> Way:
    """A window's displacements scaled, bent and turned as they fit best, and laid with the last sample where it was."""
    assert place.heading_rad is not None
    d = np.asarray(window.displacement_m, dtype=np.float64)[:, :2]
    step = np.diff(d, axis=0)
    path = path_length_m(d)
    device_yaw = _device_yaw_rad(device_to_frame)[-1]
    bend = place.heading_drift_rad_per_m * (path - path[-1])
    heading = place.heading_rad - device_yaw + bend  # of the window's frame at each sample
    middle = 0.5 * (heading[1:] + heading[:-1])
    c, s = np.cos(middle), np.sin(middle)
    turned = place.step_scale * np.stack([c * step[:, 0] - s * step[:, 1], s * step[:, 0] + c * step[:, 1]], axis=1)
    gone = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
    rotation = np.stack([yaw_matrix(float(a)) for a in heading]) @ device_to_frame
    return Way(
        np.array(place.position_m[:2]) + gone - gone[-1], rotation, covariance_m2 + SHAPE_SD_M**2 * np.eye(2), path
    )


def with_sensor(window: Window, device_to_frame: Array, model: SensorModel) -> Window:
    """The window as that sensor, calibrated, would have told it."""
    body = np.einsum("nji,nj->ni", device_to_frame, window.B_uT)
    return replace(window, B_uT=np.einsum("nij,nj->ni", device_to_frame, model.apply(body)))


def _thinned(window: Window) -> Window:
    """The first and the last sample and one a metre between."""
    path = path_length_m(np.asarray(window.displacement_m, dtype=np.float64))
    _, kept = np.unique(np.floor(path / SPACING_M), return_index=True)
    kept = np.unique(np.append(kept, len(path) - 1))

    def thin(each: Array | None) -> Array | None:
        return None if each is None else each[kept]

    return replace(
        window, B_uT=window.B_uT[kept], displacement_m=window.displacement_m[kept], t_s=thin(window.t_s),
        yaw_rad=thin(window.yaw_rad), device_to_frame=thin(window.device_to_frame),
    )  # fmt: skip


def _device_to_frame(window: Window) -> Array:
    """(n, 3, 3). Raises InvalidInput where the window does not tell."""
    if window.frame != "level":
        message = "A calibration on a map takes a window of the level frame, with how the device was turned."
        raise InvalidInput(message, Fault("window/frame", "not level"))
    if window.device_to_frame is not None:
        return window.device_to_frame
    if window.yaw_rad is None:
        message = "The window does not tell how the device was turned: send yaw_rad, or readings in body axes."
        raise InvalidInput(message, Fault("window/yaw_rad", "absent"))
    return np.stack([yaw_matrix(float(a)) for a in window.yaw_rad])
