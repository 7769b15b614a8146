"""A window as the search sees it: few samples, a lattice of courses, and each sample placed and turned by each course.

A course is a heading of the window's frame, a scale of its displacements and a drift of its heading; a pose is
`(course, cell of the last sample)`. Displacements are rounded to whole cells per course, so that a block of poses
displaced by a sample is a block of cells.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from app.errors import Fault, InvalidInput
from app.field.samples import Components
from app.geometry import Array
from app.positioning.features import window_features
from app.positioning.window import Window, course_yaw_rad

__all__ = [
    "Courses", "ReducedWindow", "Steps", "Turned", "bent_m", "course_lattice", "heading_lattice",
    "lattice_noise_uT2", "reduce_window", "single_course",
    "turn_window", "widest_steps",
]  # fmt: skip

MIN_HEADINGS, MAX_HEADINGS = 72, 720
MAX_SCALES, MAX_DRIFTS = 13, 9
MOST_SAMPLES = 200  # of a reduced window
LEAST_HEADING_SD_RAD = 1e-4
_HEADING_PRIOR_SDS = 4.5  # how far a heading prior is searched
_NUISANCE_PRIOR_SDS = 2.6  # how far scale and drift are searched: 99 % of their prior
_LOSS_NATS = 2.5  # what a course midway between two of the lattice may cost


@dataclass(frozen=True, slots=True, eq=False)
class ReducedWindow:
    """The samples that are matched, in order of time.

    features_uT            (n, c) mean of the samples walked over within one spacing, in the window's frame, scaled
    from_last_m            (n, 2) their position from the last sample, in the window's frame
    noise_variance_uT2     (n,) of the mean of those samples
    path_m                 (n,) distance walked
    components             what the features are
    scale                  (c,) what the components were multiplied by
    turns                  whether a heading turns the features (vector components of a level window)
    yaw_rad                (n,) of the sensor in the window's frame; zero where features are not vectors
    tilt                   (n, 3, 3) rotation from the frame's axes turned by yaw to the sensor's, or (0, 3, 3): upright
    """

    features_uT: Array
    from_last_m: Array
    noise_variance_uT2: Array
    path_m: Array
    components: Components
    scale: Array
    turns: bool
    yaw_rad: Array
    tilt: Array

    def __len__(self) -> int:
        return len(self.features_uT)


@dataclass(frozen=True, slots=True, eq=False)
class Courses:
    """Hypotheses of a window's course, (h,) each.

    heading_rad           yaw of the window's frame, half-way along the path
    scale                 true over told displacements
    drift_rad_per_m       heading gained per metre walked, beyond what was told
    log_prior             log weight: over scales and drifts it sums to one; the heading's is a density up to a constant
    steps                 distance between neighbouring values; of one value alone what is as uncertain: sqrt(12) sds
    """

    heading_rad: Array
    scale: Array
    drift_rad_per_m: Array
    log_prior: Array
    steps: "Steps"

    def __len__(self) -> int:
        return len(self.heading_rad)


@dataclass(frozen=True, slots=True)
class Steps:
    """The lattice's spacing: heading (rad), scale, drift (rad/m)."""

    heading_rad: float
    scale: float
    drift_rad_per_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """A window at every course.

    features_uT (h, n, c), offset_cells (h, n, 2) (row, column) from the last sample, turn (h, n, 2) cosine and sine of
    the sensor's yaw in the building frame as told: heading and yaw, without the drift, which is small and which an
    offset of the sensor must not turn with, so that a heading turns the offsets of all samples alike
    """

    features_uT: Array
    offset_cells: NDArray[np.int64]
    turn: Array


def reduce_window(
    window: Window, components: Components, spacing_m: float, scale: Array | None = None
) -> ReducedWindow:
    """Average the samples within each `spacing_m` walked: standing still adds no position information.

    Of more than `MOST_SAMPLES` averages, that many are kept, evenly spaced, the first and the last among them.
    """
    displacement = np.asarray(window.displacement_m, dtype=np.float64)[:, :2]
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(displacement, axis=0), axis=1))])
    bins = np.floor(path / spacing_m + 1e-9).astype(np.int64)
    _, first, group, count = np.unique(bins, return_index=True, return_inverse=True, return_counts=True)
    kept = np.unique(np.linspace(0, len(count) - 1, min(len(count), MOST_SAMPLES)).round().astype(np.int64))
    features = _group_means(window_features(window, components), group, count)[kept]
    scale = np.ones(features.shape[1]) if scale is None else scale
    vectors, middle = components == "vector", (first + count // 2)[kept]
    yaw, tilt = np.zeros(len(kept)), np.empty((0, 3, 3))
    if vectors and window.device_to_frame is not None:
        tilt = np.swapaxes(np.asarray(window.device_to_frame, dtype=np.float64)[middle], 1, 2)
    elif vectors:
        yaw = np.asarray(course_yaw_rad(displacement) if window.yaw_rad is None else window.yaw_rad)[middle]
    return ReducedWindow(
        features_uT=scale * features,
        from_last_m=_group_means(displacement - displacement[-1], group, count)[kept],
        noise_variance_uT2=float(np.mean(np.square(scale))) * window.noise_uT**2 / count[kept],
        path_m=_group_means(path[:, None], group, count)[kept, 0],
        components=components,
        scale=scale,
        turns=vectors and window.frame == "level",
        yaw_rad=yaw,
        tilt=np.ascontiguousarray(tilt),
    )


def widest_steps(window: ReducedWindow, gradient_uT_per_m: float, variance_uT2: Array, offset: float | None) -> Steps:
    """Steps at which a course midway between two of the lattice loses `_LOSS_NATS`, with errors' variances (n,).

    What turning and stretching the window change follows from the rms gradient of the map and the levers of the samples
    about their middle, since a pose is free to move; what an offset of precision `offset` explains does not count.
    """
    weight = 1.0 / variance_uT2
    turned, along = _turning_uT(window)
    changes = _changes_uT2(window, gradient_uT_per_m)
    heading, scale, drift = (float(weight @ change) for change in changes)
    heading += _explained(turned, weight, offset)
    drift += _explained(turned * along[:, None], weight, offset)
    return Steps(*(float(2.0 * np.sqrt(2.0 * _LOSS_NATS / max(x, 1e-12))) for x in (heading, scale, drift)))


def lattice_noise_uT2(window: ReducedWindow, gradient_uT_per_m: float, steps: Steps) -> Array:
    """(n,) variance per component of what lies between the courses of a lattice, evenly spread over its steps.

    The search scores with it, so that the true course is not lost between two of the lattice.
    """
    turned, along = _turning_uT(window)
    heading, scale, drift = _changes_uT2(window, gradient_uT_per_m)
    turning = np.sum(np.square(turned), axis=1)
    total = (heading + turning) * steps.heading_rad**2 + scale * steps.scale**2
    total = total + (drift + turning * np.square(along)) * steps.drift_rad_per_m**2
    return np.asarray(total / (12.0 * window.features_uT.shape[1]))


def _changes_uT2(window: ReducedWindow, gradient_uT_per_m: float) -> tuple[Array, Array, Array]:
    """(n,) expected squared change of the field a sample meets, per squared heading, scale and drift."""
    across = 0.5 * gradient_uT_per_m**2
    centred = window.from_last_m - window.from_last_m.mean(axis=0)
    lever2 = across * np.sum(np.square(centred), axis=1)
    _, sideways = bent_m(window, np.zeros(1))
    sideways = sideways - sideways.mean(axis=0)
    return lever2, lever2, across * np.sum(np.square(sideways), axis=1)


def _turning_uT(window: ReducedWindow) -> tuple[Array, Array]:
    """Change of the features' horizontal part with the heading (n, 2), uT/rad, and distance from mid-path (n,), m."""
    along = window.path_m - 0.5 * (window.path_m[0] + window.path_m[-1])
    if not window.turns:
        return np.zeros((len(window), 2)), along
    return np.column_stack([-window.features_uT[:, 1], window.features_uT[:, 0]]), along


def heading_lattice(window: Window, step_rad: float) -> Array:
    """Yaws of the window's frame to search, (h,), at most `step_rad` apart; a building window has the one yaw zero.

    A heading with an sd is searched within 4.5 sd, one without (or with an sd of zero) is believed.
    Raises InvalidInput for an sd below 1e-4.
    """
    if window.heading_sd_rad and window.heading_sd_rad < LEAST_HEADING_SD_RAD:
        raise InvalidInput(
            f"heading_sd_rad is {window.heading_sd_rad:g}: no heading is known that well; give at least "
            f"{LEAST_HEADING_SD_RAD:g}, or leave it out to have the heading believed",
            Fault("/window/heading_sd_rad", f"must be at least {LEAST_HEADING_SD_RAD:g}"),
        )
    if window.frame == "building":
        return np.zeros(1)
    reach = np.pi
    centre = window.heading_rad
    if centre is not None:
        reach = min(np.pi, _HEADING_PRIOR_SDS * (window.heading_sd_rad or 0.0))
    if reach >= np.pi:
        count = int(np.ceil(2 * np.pi / step_rad - 1e-9))
        return np.asarray((centre or 0.0) + 2 * np.pi / count * np.arange(count))
    sides = int(np.ceil(reach / step_rad))
    return np.asarray((centre or 0.0) + np.linspace(-reach, reach, 2 * sides + 1))


def course_lattice(window: Window, steps: Steps, scale_sd: float, drift_sd_rad_per_m: float) -> Courses:
    """Every heading with every scale and drift that their priors leave likely, at most `steps` apart."""
    widest = float(np.clip(steps.heading_rad, 2 * np.pi / MAX_HEADINGS, 2 * np.pi / MIN_HEADINGS))
    heading = heading_lattice(window, widest)
    heading_log = np.zeros(len(heading))
    if window.frame != "building" and window.heading_rad is not None and window.heading_sd_rad:
        off = np.angle(np.exp(1j * (heading - window.heading_rad)))
        heading_log = -0.5 * np.square(off / window.heading_sd_rad)
    turning_sd = 0.0 if window.frame == "building" else drift_sd_rad_per_m
    scale, scale_log, scale_step = _nodes(scale_sd, steps.scale, MAX_SCALES)
    drift, drift_log, drift_step = _nodes(turning_sd, steps.drift_rad_per_m, MAX_DRIFTS)
    h, s, d = (a.ravel() for a in np.meshgrid(np.arange(len(heading)), np.arange(len(scale)), np.arange(len(drift)),
                                              indexing="ij"))  # fmt: skip
    heading_step = float(abs(heading[1] - heading[0])) if len(heading) > 1 else 0.0
    return Courses(
        heading[h], 1.0 + scale[s], drift[d], heading_log[h] + scale_log[s] + drift_log[d],
        Steps(heading_step, scale_step, drift_step),
    )  # fmt: skip


def single_course(heading_rad: Array) -> Courses:
    """Headings (h,) alone, all alike: displacements as told."""
    h = len(heading_rad)
    step = float(abs(heading_rad[1] - heading_rad[0])) if h > 1 else 0.0
    return Courses(np.asarray(heading_rad), np.ones(h), np.zeros(h), np.zeros(h), Steps(step, 0.0, 0.0))


def turn_window(window: ReducedWindow, courses: Courses, resolution_m: float) -> Turned:
    """Place and turn the samples in the building frame for every course, and round places to cells."""
    along = window.path_m - 0.5 * (window.path_m[0] + window.path_m[-1])
    yaw = courses.heading_rad[:, None] + courses.drift_rad_per_m[:, None] * along
    c, s = np.cos(yaw), np.sin(yaw)
    p = _placed_m(window, courses)
    offsets = np.rint(np.stack([p[..., 1], p[..., 0]], axis=-1) / resolution_m).astype(np.int64)
    features = np.broadcast_to(window.features_uT, (len(courses), *window.features_uT.shape)).copy()
    turn = np.zeros((len(courses), len(window), 2))
    turn[..., 0] = 1.0
    if window.turns:
        x, y = window.features_uT[:, 0], window.features_uT[:, 1]
        features[..., 0], features[..., 1] = c * x - s * y, s * x + c * y
    if window.components == "vector":
        sensor = window.yaw_rad + (courses.heading_rad[:, None] if window.turns else 0.0 * yaw)
        turn[..., 0], turn[..., 1] = np.cos(sensor), np.sin(sensor)
    return Turned(features, offsets, turn)


def _placed_m(window: ReducedWindow, courses: Courses) -> Array:
    """(h, n, 2) positions from the last sample in the building frame: turned, stretched and bent."""
    c, s = np.cos(courses.heading_rad)[:, None], np.sin(courses.heading_rad)[:, None]
    told, _ = bent_m(window, courses.drift_rad_per_m)
    dx, dy = courses.scale[:, None] * told[..., 0], courses.scale[:, None] * told[..., 1]
    return np.stack([c * dx - s * dy, s * dx + c * dy], axis=-1)


def bent_m(window: ReducedWindow, drift_rad_per_m: Array) -> tuple[Array, Array]:
    """Positions from the last sample (h, n, 2), in the window's frame, under drifts (h,) of its heading about mid-path
    (first order), and their derivative with the drift (n, 2)."""
    along = window.path_m - 0.5 * (window.path_m[0] + window.path_m[-1])
    step = np.diff(window.from_last_m, axis=0)
    turned = np.column_stack([-step[:, 1], step[:, 0]]) * (0.5 * (along[1:] + along[:-1]))[:, None]
    gained = np.concatenate([np.zeros((1, 2)), np.cumsum(turned, axis=0)])
    sideways = gained - gained[-1]
    return window.from_last_m + drift_rad_per_m[:, None, None] * sideways, sideways


def _explained(turned: Array, weight: Array, offset: float | None) -> float:
    """Weighted squares of vectors (n, 2), less what a constant explains."""
    squares = float(weight @ np.sum(np.square(turned), axis=1))
    if offset is None:
        return squares
    return squares - float(np.sum(np.square(weight @ turned))) / (float(weight.sum()) + offset)


def _nodes(sd: float, step: float, most: int) -> tuple[Array, Array, float]:
    """Values about zero within the prior, their log weights (summing to one), and their spacing."""
    reach = _NUISANCE_PRIOR_SDS * sd
    if reach <= 0.5 * step:
        return np.zeros(1), np.zeros(1), float(np.sqrt(12.0) * sd)
    sides = min(int(np.ceil(reach / step - 0.5)), most // 2)
    value = np.linspace(-sides, sides, 2 * sides + 1) * (reach / (sides + 0.5))
    half = reach / (2 * sides + 1)
    weight = norm.cdf((value + half) / sd) - norm.cdf((value - half) / sd)
    return value, np.log(weight / weight.sum()), 2.0 * half


def _group_means(values: Array, group: NDArray[np.int64], count: NDArray[np.int64]) -> Array:
    sums = np.zeros((len(count), values.shape[1]))
    np.add.at(sums, group, values)
    return sums / count[:, None]
