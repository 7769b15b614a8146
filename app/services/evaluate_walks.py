"""How good are maps and fixes on real walks? Hold walks out, map the rest, locate windows of the held-out ones.

A folder holds one folder per floor with walks of format `indoor-location-2020`. One walk in five, by file name, is held
out; nothing of it is used for the maps. Windows are cut from held-out walks by distance, with displacement and heading
as the phone reckoned them; labels are used only to judge. Floors and windows run in child processes, each with BLAS on
one thread.
"""

import gzip
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from threadpoolctl import threadpool_limits

from app.errors import Fault, InvalidInput, UnreadableSurvey
from app.field.body_bias import BodyBias
from app.field.fit import fit_map
from app.field.grid import FieldGrid
from app.field.samples import Samples
from app.field.session_bias import estimate_session_biases, remove_session_biases, unmet_session
from app.field.spec import FittedMap, MapSpec, Noise, Score
from app.geometry import Array, rotate_by_quaternion
from app.positioning.fix import Fix, LocateOptions
from app.positioning.locate import SearchableFloor, locate, prepare_floor, prepare_floors
from app.positioning.window import Composition, Window
from app.services.map_scores import Estimate, HeldOutWalk, MapScore, held_out_walk, nlpd_gain, score_map
from app.survey.read import read_survey
from app.survey.walk import DeadReckoning, Walk

__all__ = [
    "HELD_OUT_EVERY", "NOISES", "EvaluatedFloor", "Evaluation", "EvaluationPlan", "JudgedWindow", "Place", "Told",
    "calibrate_sessions", "collected", "cut_windows", "evaluate_walks", "hold_out", "on_one_thread", "read_floors",
    "session_of",
]  # fmt: skip

HELD_OUT_EVERY = 5
COVERED_WITHIN_M = 1.5
COVERED_SHARE = 0.8
SENSOR_NOISE_UT = 0.5
NOISES: tuple[Noise, ...] = ("walk", "white")
WALK_SUFFIXES = (".txt", ".txt.gz")
MAX_WALK_BYTES = 64 * 2**20

Told = Callable[[str, int, int], None]  # (stage, done, total)


@dataclass(frozen=True, slots=True)
class EvaluationPlan:
    """What to evaluate: window lengths in metres walked, the map's parameters, child processes.

    session_bias   take the hard iron that the mapping walks show for a calibration session out of its walks, held-out
                   ones included: a phone keeps its session, and its bias, from one walk to the next
    rehearse       leave the held-out walks out altogether and hold out one in five of the others: for choosing
                   parameters, so that nothing is tuned on the walks that judge
    """

    window_lengths_m: tuple[float, ...] = (10.0, 20.0, 40.0)
    spec: MapSpec = field(default_factory=lambda: MapSpec(resolution_m=1.0))
    composition: Composition = "raw"
    session_bias: bool = True
    rehearse: bool = False
    options: LocateOptions = field(default_factory=LocateOptions)
    processes: int = 2


@dataclass(frozen=True, slots=True)
class Place:
    """Where a technique put the device, against where the surveyor was."""

    right_floor: bool
    error_m: float

    def within(self, distance_m: float) -> bool:
        """On the right floor and this near."""
        return self.right_floor and self.error_m <= distance_m


@dataclass(frozen=True, slots=True)
class JudgedWindow:
    """One window of a held-out walk and what each technique made of it; None where a technique did not answer.

    All techniques search every floor, but `ml_floor_known`: maximum likelihood on the right floor alone.
    """

    floor_id: str
    walk: str
    length_m: float
    covered: bool
    status: str
    ml: Place | None
    ml_floor_known: Place | None
    mlr: Place | None
    abl: Place | None
    posterior: Place | None
    floor_probability: float
    radius_68_m: float
    radius_95_m: float


@dataclass(frozen=True, slots=True)
class EvaluatedFloor:
    """One floor's map: its walks, its own score, and its score on the walks that were held out.

    held_out_white: of a map of the same walks that takes all errors to be white. nlpd_gain_over_white: how much lower
    the held-out NLPD is than that map's.
    """

    floor_id: str
    mapping_walks: tuple[str, ...]
    held_out_walks: tuple[str, ...]
    components: tuple[str, ...]
    leave_one_out: Score | None
    leave_one_out_reason: str | None
    held_out: MapScore | None
    held_out_white: MapScore | None
    nlpd_gain_over_white: Estimate | None
    hyperparameters: Mapping[str, object]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Everything that was found, window by window."""

    floors: tuple[EvaluatedFloor, ...]
    windows: tuple[JudgedWindow, ...]
    unreadable: Mapping[str, str]


def evaluate_walks(directory: Path, plan: EvaluationPlan, told: Told) -> Evaluation:
    """Evaluate the floors under `directory`. Raises InvalidInput when there is nothing to evaluate."""
    floors, unreadable = read_floors(directory, told)
    if plan.rehearse:
        floors = {floor_id: {name: walks[name] for name in hold_out(walks)[0]} for floor_id, walks in floors.items()}
    spec = replace(plan.spec, hard_iron=plan.session_bias)
    mapping = {floor_id: _mapping_samples(walks) for floor_id, walks in floors.items()}
    biases: dict[str, dict[str, BodyBias] | None] = dict.fromkeys(floors)
    if plan.session_bias:
        biases = {floor_id: estimate_session_biases(samples) for floor_id, samples in mapping.items()}
        floors = {floor_id: calibrate_sessions(walks, biases[floor_id] or {}) for floor_id, walks in floors.items()}
    with ProcessPoolExecutor(plan.processes, get_context("spawn"), initializer=on_one_thread) as pool:
        fits = {
            pool.submit(_fit_floor, samples, replace(spec, noise=noise)): (floor_id, noise)
            for floor_id, samples in mapping.items()
            for noise in NOISES
        }
        by_noise = dict(collected(fits, told, "fitting maps"))
    fitted = {floor_id: by_noise[floor_id, plan.spec.noise] for floor_id in floors}
    tasks = [
        (floor_id, name, floors[floor_id][name], _mapped_places(floors[floor_id]))
        for floor_id in floors
        for name in hold_out(floors[floor_id])[1]
    ]
    arguments = ({floor_id: each.grid for floor_id, each in fitted.items()}, plan)
    with ProcessPoolExecutor(plan.processes, get_context("spawn"), _ready_to_locate, arguments) as pool:
        judged = dict(collected({pool.submit(_judge_walk, *task): task[:2] for task in tasks}, told, "locating"))
    return Evaluation(
        floors=tuple(
            _evaluated_floor(floor_id, walks, fitted[floor_id], by_noise[floor_id, "white"], biases[floor_id])
            for floor_id, walks in floors.items()
        ),
        windows=tuple(window for key in sorted(judged) for window in judged[key]),
        unreadable=unreadable,
    )


def hold_out(walks: Mapping[str, object], fold: int = HELD_OUT_EVERY - 1) -> tuple[list[str], list[str]]:
    """(names to map, names held out): every fifth in order of name is held out, from the fifth or another on."""
    names = sorted(walks)
    held_out = names[fold::HELD_OUT_EVERY]
    return [name for name in names if name not in set(held_out)], held_out


def calibrate_sessions(walks: Mapping[str, Walk], biases: Mapping[str, BodyBias]) -> dict[str, Walk]:
    """The walks of a floor without the offset of their calibration session."""
    samples = remove_session_biases({name: walk.samples for name, walk in walks.items()}, biases)
    return {
        name: replace(walk, samples=samples[name], dead_reckoning=_calibrated(walk, biases))
        for name, walk in walks.items()
    }


def _calibrated(walk: Walk, biases: Mapping[str, BodyBias]) -> DeadReckoning | None:
    reckoned, bias = walk.dead_reckoning, biases.get(str(walk.samples.session))
    if reckoned is None or bias is None:
        return reckoned
    offset_uT = np.broadcast_to(bias.bias_body_uT, reckoned.B_level_uT.shape)
    return replace(reckoned, B_level_uT=reckoned.B_level_uT - rotate_by_quaternion(reckoned.q_body_to_level, offset_uT))


def cut_windows(reckoned: DeadReckoning, length_m: float) -> Iterator[tuple[slice, Window]]:
    """Windows of a length walked, each half a length after the last, as the phone would send them at their end.

    The heading is what the phone believed at the window's last sample, carried back to its first.
    """
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(reckoned.displacement_m, axis=0), axis=1))])
    for start_m in np.arange(0.0, path_m[-1] - length_m, 0.5 * length_m):
        first, last = np.searchsorted(path_m, [start_m, start_m + length_m])
        part = slice(int(first), int(last) + 1)
        turned_rad = reckoned.yaw_rad[part] - reckoned.yaw_rad[first]
        heading_rad, heading_sd_rad = None, None
        if reckoned.heading_rad is not None and reckoned.heading_sd_rad is not None:
            heading_rad = float(reckoned.heading_rad[last] - turned_rad[-1])
            heading_sd_rad = float(reckoned.heading_sd_rad[last])
        yield (
            part,
            Window(
                frame="level",
                B_uT=_turned(reckoned.B_level_uT[part], turned_rad),
                displacement_m=_turned(
                    reckoned.displacement_m[part] - reckoned.displacement_m[first],
                    np.full(len(turned_rad), -reckoned.yaw_rad[first]),
                ),
                noise_uT=SENSOR_NOISE_UT,
                heading_rad=heading_rad,
                heading_sd_rad=heading_sd_rad,
                yaw_rad=turned_rad,
            ),
        )


def _turned(v: Array, angle_rad: Array) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]])


def read_floors(directory: Path, told: Told) -> tuple[dict[str, dict[str, Walk]], dict[str, str]]:
    """Floor -> name -> walk, and what could not be read and why. Raises InvalidInput when there is nothing."""
    files = [
        (folder.name, file)
        for folder in sorted(path for path in directory.iterdir() if path.is_dir())
        for file in sorted(folder.iterdir())
        if file.name.endswith(WALK_SUFFIXES)
    ]
    floors: dict[str, dict[str, Walk]] = {}
    unreadable: dict[str, str] = {}
    for done, (floor_id, file) in enumerate(files, start=1):
        try:
            floors.setdefault(floor_id, {})[file.name.split(".")[0]] = read_survey(
                _walk_bytes(file), format="indoor-location-2020"
            )
        except UnreadableSurvey as error:
            unreadable[f"{floor_id}/{file.name}"] = str(error)
        told("reading walks", done, len(files))
    floors = {floor_id: walks for floor_id, walks in floors.items() if len(walks) >= HELD_OUT_EVERY}
    if not floors:
        raise InvalidInput(
            f"{directory} holds no floor to evaluate; give a folder with one folder per floor, each with at least "
            f"{HELD_OUT_EVERY} readable walks (*.txt or *.txt.gz) of format indoor-location-2020",
            *(Fault(name, reason) for name, reason in unreadable.items()),
        )
    return floors, unreadable


def _walk_bytes(file: Path) -> bytes:
    """The bytes of a walk, unpacked if need be. Raises UnreadableSurvey for a damaged or oversize archive."""
    if not file.name.endswith(".gz"):
        return file.read_bytes()
    try:
        with gzip.open(file) as stream:
            data = stream.read(MAX_WALK_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise UnreadableSurvey(f"the archive is damaged: {error}", Fault("file", str(error))) from error
    if len(data) > MAX_WALK_BYTES:
        raise UnreadableSurvey(f"the archive unpacks to more than {MAX_WALK_BYTES:,} bytes", Fault("file", "too large"))
    return data


def collected(futures: Mapping[Future[Any], Any], told: Told, stage: str) -> Iterator[tuple[Any, Any]]:
    """(key, result) of every future, as they come."""
    told(stage, 0, len(futures))
    for done, future in enumerate(as_completed(futures), start=1):
        yield futures[future], future.result()
        told(stage, done, len(futures))


def on_one_thread() -> None:
    """BLAS, in a child process."""
    threadpool_limits(1)


def _fit_floor(walks: Mapping[str, Samples], spec: MapSpec) -> FittedMap:
    return fit_map(walks, spec)


_floors: list[SearchableFloor] = []
_floor_alone: dict[str, SearchableFloor] = {}
_plan = EvaluationPlan()


def _ready_to_locate(grids: Mapping[str, Any], plan: EvaluationPlan) -> None:
    """Once per child process: the floors ready for searching, together and each alone."""
    global _plan
    on_one_thread()
    _floors[:] = prepare_floors(grids)
    _floor_alone.update((floor_id, prepare_floor(floor_id, grid)) for floor_id, grid in grids.items())
    _plan = plan


def _judge_walk(floor_id: str, name: str, walk: Walk, mapped_m: Array) -> list[JudgedWindow]:
    """Every window of one held-out walk, located over all floors without a prior."""
    assert walk.dead_reckoning is not None
    p_m = walk.samples.p_building_m[:, :2]
    distance_m, _ = cKDTree(mapped_m).query(p_m)
    near = np.asarray(distance_m) <= COVERED_WITHIN_M
    right_floor = [_floor_alone[floor_id]]
    judged = []
    for length_m in _plan.window_lengths_m:
        for part, window in cut_windows(walk.dead_reckoning, length_m):
            fix = locate(window, _floors, composition=_plan.composition, options=_plan.options)
            alone = locate(window, right_floor, composition=_plan.composition, techniques=(), options=_plan.options)
            covered = bool(near[part].mean() >= COVERED_SHARE)
            judged.append(_judge(fix, alone, floor_id, name, length_m, covered, p_m[part][-1]))
    return judged


def _judge(
    fix: Fix, alone: Fix, floor_id: str, walk: str, length_m: float, covered: bool, truth_m: Array
) -> JudgedWindow:
    def place(estimate: Any) -> Place | None:
        if estimate is None or estimate.position_m is None:
            return None
        error_m = float(np.linalg.norm(np.array(estimate.position_m[:2]) - truth_m))
        return Place(estimate.floor_id == floor_id, error_m)

    belief = fix.posterior
    return JudgedWindow(
        floor_id=floor_id,
        walk=walk,
        length_m=length_m,
        covered=covered,
        status=fix.status,
        ml=place(fix.ml),
        ml_floor_known=place(alone.ml),
        mlr=place(fix.mlr) if fix.mlr.available else None,
        abl=place(fix.abl) if fix.abl.available else None,
        posterior=place(belief),
        floor_probability=belief.floor_probability.get(floor_id, 0.0) if belief else 0.0,
        radius_68_m=belief.radius_68_m if belief else np.inf,
        radius_95_m=belief.radius_95_m if belief else np.inf,
    )


def _mapping_samples(walks: Mapping[str, Walk]) -> dict[str, Samples]:
    """The walks to map."""
    return {name: walks[name].samples for name in hold_out(walks)[0]}


def _mapped_places(walks: Mapping[str, Walk]) -> Array:
    """(n, 2) positions of all mapping walks of a floor."""
    return np.concatenate([walks[name].samples.p_building_m[:, :2] for name in hold_out(walks)[0]])


def _evaluated_floor(
    floor_id: str,
    walks: Mapping[str, Walk],
    fitted: FittedMap,
    white: FittedMap,
    biases: Mapping[str, BodyBias] | None,
) -> EvaluatedFloor:
    mapping, held_out = hold_out(walks)
    mapped_m = _mapped_places(walks)

    def against(grid: FieldGrid) -> list[HeldOutWalk]:
        samples = [walks[name].samples for name in held_out]
        return [held_out_walk(grid, each, mapped_m, session_of(each, biases)) for each in samples]

    judged, judged_white = against(fitted.grid), against(white.grid)
    return EvaluatedFloor(
        floor_id=floor_id,
        mapping_walks=tuple(mapping),
        held_out_walks=tuple(held_out),
        components=fitted.grid.component_names,
        leave_one_out=fitted.score,
        leave_one_out_reason=fitted.score_reason,
        held_out=score_map(judged),
        held_out_white=score_map(judged_white),
        nlpd_gain_over_white=nlpd_gain(judged, judged_white),
        hyperparameters=fitted.hyperparameters,
    )


def session_of(samples: Samples, biases: Mapping[str, BodyBias] | None) -> BodyBias | None:
    """What is known of the walk's session; None where nothing was taken out of any."""
    if biases is None or samples.session is None or samples.q_body_to_building is None:
        return None
    return biases.get(samples.session) or unmet_session(samples)
