"""Windows of a walk whose places are known: cut, located, and judged."""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from app.field.grid import FieldGrid
from app.geometry import Array
from app.positioning.fix import Fix, LocateOptions, Posterior, Prior
from app.positioning.locate import SearchableFloor, locate, prepare_floor, prepare_floors
from app.positioning.window import Composition, Window
from app.survey.walk import DeadReckoning, Walk

__all__ = [
    "COVERED_SHARE", "COVERED_WITHIN_M", "PHONE", "SHARES", "Answer", "Floors", "JudgedWindow", "Place", "Question",
    "cut_windows", "disc_centre_m", "judge_walk",
]  # fmt: skip

COVERED_WITHIN_M = 1.5
COVERED_SHARE = 0.8
SENSOR_NOISE_UT = 0.5
SHARES = (0.50, 0.68, 0.90, 0.95)
"""Of the probability, that the radii of a posterior hold."""

PHONE = LocateOptions(bias_sd_uT=2.0, step_scale_sd=0.12)
"""What is not known of a phone that somebody carries: chosen on windows of mapping walks (docs/evaluation.md)."""


@dataclass(frozen=True, slots=True)
class Question:
    """How windows are asked: lengths in metres walked, and what `locate` is told besides.

    disc_m    radius of the disc about the truth that a prior position is drawn from, evenly; 0: not asked
    """

    window_lengths_m: tuple[float, ...] = (10.0, 20.0, 40.0)
    composition: Composition = "raw"
    disc_m: float = 20.0
    options: LocateOptions = PHONE


@dataclass(frozen=True, slots=True)
class Place:
    """Where a technique put the device, against where the surveyor was."""

    right_floor: bool
    error_m: float

    def within(self, distance_m: float) -> bool:
        """On the right floor and this near."""
        return self.right_floor and self.error_m <= distance_m


@dataclass(frozen=True, slots=True)
class Answer:
    """What a posterior says, judged.

    position           the posterior's own; `strongest`: of its strongest mode, whose probability is `confidence`, off
                       the map counted in
    floor_probability  of the floor it says
    radii_m            that hold SHARES of the mass on that floor
    """

    status: str
    position: Place
    strongest: Place
    confidence: float
    floor_probability: float
    off_map_probability: float
    radii_m: tuple[float, ...]

    def holds(self, share: int) -> bool:
        """Whether the truth is on the floor it says, within the radius of SHARES[share]."""
        return self.position.within(self.radii_m[share])


@dataclass(frozen=True, slots=True)
class JudgedWindow:
    """One window of a held-out walk and what each technique made of it; None where a technique did not answer.

    All techniques search every floor, but `ml_floor_known` (maximum likelihood) and `disc` (a posterior that was told a
    prior position): those search the right floor alone.
    """

    floor_id: str
    walk: str
    length_m: float
    covered: bool
    ml: Place | None
    ml_floor_known: Place | None
    mlr: Place | None
    abl: Place | None
    answer: Answer
    disc: Answer | None

    @property
    def posterior(self) -> Place:
        return self.answer.position

    @property
    def strongest(self) -> Place:
        return self.answer.strongest

    @property
    def prior_disc(self) -> Place | None:
        return self.disc.position if self.disc else None


@dataclass(frozen=True, slots=True, eq=False)
class Floors:
    """Floors ready for searching: together, and each alone under its own noise."""

    together: Sequence[SearchableFloor]
    alone: Mapping[str, SearchableFloor]

    @classmethod
    def of(cls, grids: Mapping[str, FieldGrid]) -> "Floors":
        return cls(prepare_floors(grids), {floor_id: prepare_floor(floor_id, grid) for floor_id, grid in grids.items()})


def cut_windows(
    reckoned: DeadReckoning, length_m: float, every_m: float | None = None
) -> Iterator[tuple[slice, Window]]:
    """Windows of a length walked, one `every_m` (None: half a length), as the phone would send them at their end.

    The heading is what the phone believed at the window's last sample, carried back to its first.
    """
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(reckoned.displacement_m, axis=0), axis=1))])
    for start_m in np.arange(0.0, path_m[-1] - length_m, 0.5 * length_m if every_m is None else every_m):
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


def judge_walk(
    floors: Floors, floor_id: str, name: str, walk: Walk, mapped_m: Array, question: Question
) -> list[JudgedWindow]:
    """Every window of one walk: located over all floors, and on the right one without and with a prior position.

    mapped_m (n, 2): positions of the walks its floor was mapped by.
    """
    assert walk.dead_reckoning is not None
    p_m = walk.samples.p_building_m[:, :2]
    distance_m, _ = cKDTree(mapped_m).query(p_m)
    near = np.asarray(distance_m) <= COVERED_WITHIN_M
    right = [floors.alone[floor_id]]
    composition, options = question.composition, question.options
    judged = []
    for length_m in question.window_lengths_m:
        for number, (part, window) in enumerate(cut_windows(walk.dead_reckoning, length_m)):
            truth_m = p_m[part][-1]
            fix = locate(window, floors.together, composition=composition, options=options)
            alone = locate(window, right, composition=composition, techniques=(), options=options)
            judge = _Judge(floor_id, truth_m)
            disc = None
            if question.disc_m > 0.0:
                centre_m = disc_centre_m(truth_m, question.disc_m, f"{floor_id}/{name}/{length_m:g}/{number}")
                height_m = right[0].planes[0].height_m
                prior = Prior((float(centre_m[0]), float(centre_m[1]), height_m), 0.5 * question.disc_m)
                disc = judge.answer(
                    locate(window, right, composition=composition, techniques=(), prior=prior, options=options)
                )
            judged.append(JudgedWindow(
                floor_id=floor_id,
                walk=name,
                length_m=length_m,
                covered=bool(near[part].mean() >= COVERED_SHARE),
                ml=judge.place(fix.ml),
                ml_floor_known=judge.place(alone.ml),
                mlr=judge.place(fix.mlr) if fix.mlr.available else None,
                abl=judge.place(fix.abl) if fix.abl.available else None,
                answer=judge.answer(fix),
                disc=disc,
            ))  # fmt: skip
    return judged


def disc_centre_m(truth_m: Array, radius_m: float, name: str) -> Array:
    """A place drawn evenly from a disc about the truth, one for each name; its sd per axis is half the radius."""
    rng = np.random.default_rng(zlib.crc32(name.encode()))
    along_m, angle_rad = radius_m * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
    return np.asarray(truth_m + along_m * np.array([np.cos(angle_rad), np.sin(angle_rad)]))


@dataclass(frozen=True, slots=True, eq=False)
class _Judge:
    floor_id: str
    truth_m: Array

    def place(self, estimate: Any) -> Place | None:
        """An estimate with a floor and a position, judged; None for one without a position."""
        if estimate is None or estimate.position_m is None:
            return None
        error_m = float(np.linalg.norm(np.array(estimate.position_m[:2]) - self.truth_m))
        return Place(estimate.floor_id == self.floor_id, error_m)

    def answer(self, fix: Fix) -> Answer:
        """A fix's posterior, judged."""
        belief = fix.posterior
        assert belief is not None  # there is a floor to search
        position = self.place(belief)
        assert position is not None
        strongest = self.place(belief.modes[0]) if belief.modes else None
        return Answer(
            status=fix.status,
            position=position,
            strongest=strongest or position,
            confidence=_confidence(belief),
            floor_probability=belief.floor_probability[belief.floor_id],
            off_map_probability=belief.off_map_probability,
            radii_m=(belief.radius_50_m, belief.radius_68_m, belief.radius_90_m, belief.radius_95_m),
        )


def _confidence(belief: Posterior) -> float:
    strongest = belief.modes[0].probability if belief.modes else 0.0
    return strongest * (1.0 - belief.off_map_probability)
