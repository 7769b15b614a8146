"""What a track is followed by, pinned when it is made, as JSON and as a tracker.

Maps never change under their hash and options are written out with their values, so that the same steps give the same
track later on, whatever was built or tuned since.
"""

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.calibration.sensor_model import SensorModel
from app.errors import Fault, InvalidInput
from app.geometry import Array
from app.positioning.window import WindowFrame
from app.services.calibrations import AppliedCalibration, model_as_json, stored_model
from app.services.grid_cache import GridCache
from app.services.locate_window import ActiveMap
from app.tracking.attitude import AttitudeReference
from app.tracking.ground import Connector, Ground, barriers_of
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.track import make_tracker
from app.tracking.track_state import Tracker

__all__ = ["StepKind", "TrackSpec", "Trackers", "check_walkable", "core_frame", "make_spec", "step_kind"]

TrackSpec = dict[str, Any]
"""`maps` [[floor id, map id, hash of the grid]], `options` by name, `prior`, and `ground`: `walkable` polygons and
`walls` by floor id, `connectors`; all coordinates building metres; `orientation_frame` and `calibration` of frame
body; `attitude`: the reference of its own attitude."""

_MOST_TRACKERS = 32


def core_frame(spec: TrackSpec, frame: str) -> WindowFrame:
    """The core's frame of a frame of the contract: a body step is turned to another as it comes in."""
    if frame == "body":
        return spec.get("orientation_frame", "building")  # type: ignore[no-any-return]
    return frame  # type: ignore[return-value]


def make_spec(
    maps: Sequence[ActiveMap],
    options: TrackOptions,
    prior: StartPrior | None,
    ground: Mapping[str, Any],
    orientation_frame: str,
    calibration: AppliedCalibration | None,
    attitude: Mapping[str, Any] | None,
) -> TrackSpec:
    """Everything that is pinned, as JSON."""
    told = {name: value for name, value in asdict(replace(options, ground=None)).items() if name != "ground"}
    return {
        "maps": [[each.floor_id, each.map_id, each.grid_sha256] for each in maps],
        "options": told,
        "prior": None if prior is None else {"position_m": list(prior.position_m), "sd_m": prior.sd_m},
        "ground": dict(ground),
        "orientation_frame": orientation_frame,
        "calibration": None if calibration is None else calibration.told | model_as_json(calibration.model),
        "attitude": None if attitude is None else dict(attitude),
    }


@dataclass(frozen=True, slots=True, eq=False)
class StepKind:
    """What the steps of a track are: their frame, what readings are calibrated by, whether they may bring inertial

    samples, and whether those tell the orientation that readings of frame body are turned by.
    """

    frame: str
    calibration: SensorModel | None = None
    attitude: bool = False
    own_orientation: bool = False


def step_kind(spec: TrackSpec, frame: str) -> StepKind:
    told, attitude = spec.get("calibration"), spec.get("attitude")
    own = attitude is not None and attitude["reference"] == "none" and core_frame(spec, frame) == "level"
    return StepKind(frame, None if told is None else stored_model(told), attitude is not None, frame == "body" and own)


class Trackers:
    """Trackers of pinned specifications. Those on the same maps share them: they are much the largest part."""

    def __init__(self, grids: GridCache) -> None:
        self._grids = grids
        self._shared: OrderedDict[tuple[Any, ...], Tracker] = OrderedDict()
        self._lock = Lock()

    def make(self, spec: TrackSpec, frame: str, seed: int) -> Tracker:
        """Raises IncompatibleFrames; NotFound and CorruptArtefact for a grid that is gone."""
        shared = self._of_maps(
            tuple((floor_id, sha256) for floor_id, _, sha256 in spec["maps"]), core_frame(spec, frame)
        )
        known = {field.name for field in fields(TrackOptions)}
        told = {name: value for name, value in spec["options"].items() if name in known}
        ground, prior = _ground(spec["ground"]), spec["prior"]
        walls = {} if ground is None else ground.walls
        return replace(
            shared,
            options=TrackOptions(**told, ground=ground),
            barriers=barriers_of(walls, [floor.floor_id for floor in shared.floors]),
            seed=seed,
            prior=None if prior is None else StartPrior((*prior["position_m"],), prior["sd_m"]),
            attitude=_attitude(spec.get("attitude")),
        )

    def _of_maps(self, maps: tuple[tuple[str, str], ...], frame: WindowFrame) -> Tracker:
        key = (maps, frame)
        with self._lock:
            if key in self._shared:
                self._shared.move_to_end(key)
                return self._shared[key]
        shared = make_tracker(self._grids.searchable(maps), frame, TrackOptions(), 0)
        with self._lock:
            shared = self._shared.setdefault(key, shared)
            while len(self._shared) > _MOST_TRACKERS:
                self._shared.popitem(last=False)
        return shared


def check_walkable(tracker: Tracker) -> None:
    """Raise InvalidInput where no floor has a mapped place that one can walk on."""
    ground = tracker.options.ground
    if ground is None or not ground.walkable:
        return
    for floor in tracker.floors:
        inside = ground.walkable.get(floor.floor_id)
        for plane in floor.planes:
            at = np.argwhere(plane.measured)[:, ::-1]
            points = np.asarray(plane.origin_m) + plane.resolution_m * at
            if len(points) and (inside is None or inside(points).any()):
                return
    reason = "the walkable area holds no mapped place of any floor; draw it in building metres, over the map"
    raise InvalidInput(reason, Fault("/body/options/walkable", reason))


def _attitude(told: Mapping[str, Any] | None) -> AttitudeReference | None:
    if told is None:
        return None
    if told["reference"] == "wmm":
        return AttitudeReference("constant", np.asarray(told["b_ut"], dtype=np.float64), told["sd_ut"])
    return AttitudeReference("map" if told["reference"] == "map" else "none")


def _ground(told: Mapping[str, Any]) -> Ground | None:
    walkable: Mapping[str, list[list[list[list[float]]]]] = told.get("walkable", {})
    walls: Mapping[str, list[list[list[float]]]] = told.get("walls", {})
    connectors: list[dict[str, Any]] = told.get("connectors", [])
    if not (walkable or walls or connectors):
        return None
    edges = {floor_id: [ring for rings in polygons for ring in rings] for floor_id, polygons in walkable.items()}
    lines = {floor_id: [*edges.get(floor_id, []), *walls.get(floor_id, [])] for floor_id in {*edges, *walls}}
    return Ground(
        walls={floor_id: _segments(lines[floor_id]) for floor_id in sorted(lines)},
        walkable={floor_id: _inside(polygons) for floor_id, polygons in walkable.items()},
        connectors=tuple(
            Connector(each["kind"], tuple(each["floor_ids"]), _inside(each["polygons"])) for each in connectors
        ),
    )


def _segments(lines: Sequence[Sequence[Sequence[float]]]) -> Array:
    """(k, 2, 2) of lines of positions."""
    return np.concatenate([np.stack([np.array(line)[:-1], np.array(line)[1:]], axis=1) for line in lines])


def _inside(polygons: Sequence[Sequence[Sequence[Sequence[float]]]]) -> Callable[[Array], NDArray[np.bool_]]:
    return partial(_inside_rings, [np.array(ring) for rings in polygons for ring in rings])


def _inside_rings(rings_m: Sequence[Array], points_m: Array) -> NDArray[np.bool_]:
    """(n,) which points (n, 2) lie inside an odd number of rings."""
    from matplotlib.path import Path  # costs a tenth of a second, which only those who ask should pay

    inside = np.zeros(len(points_m), dtype=np.bool_)
    for ring in rings_m:
        inside ^= Path(ring).contains_points(points_m)
    return inside
