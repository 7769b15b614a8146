"""The posterior of a matched window: mass of cells, refined modes, and the hypothesis that it is off the map."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.matching import Matched
from app.positioning.off_map import off_map
from app.positioning.posterior import (
    Atoms,
    NarrowMode,
    cell_atoms,
    distinct_poses,
    replace_narrow_modes,
    untold_variance_m2,
)
from app.positioning.refine import POSE, PoseGaussian, Refined, refine_poses
from app.positioning.scoring import pose_residuals

__all__ = ["Belief", "BelievedMode", "Optimum", "believe", "find_optima", "log_ratio", "pose_gaussian"]

MODES_APART_M = 2.0  # nearer places are one
_MODES = 8
_STARTS = 40  # candidates that are refined
START_APART_M, START_APART_RAD = 1.0, 0.35  # places and headings that have an optimum of their own
_SAME_M, _SAME_RAD = 0.1, 0.05
_HEAVY_POSES = 2000  # enough poses to judge how much of the window was measured


@dataclass(frozen=True, slots=True, eq=False)
class BelievedMode:
    """One mode: its refined pose (x, y, heading half-way, scale less one, drift), and mass relative to all on maps."""

    plane: int
    pose: Array
    log_l: float
    distance2: float
    probability: float
    refined: Refined


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """atoms: normalised mass over places. modes: strongest first. best: the mode of the most likely pose, refined.

    log_ratio      of the best optimum and the best one elsewhere; None where nothing was found elsewhere
    lattice_mass   (n,) share of each candidate pose, as the techniques take them
    unmapped       probability that nothing is mapped where the window was walked, or less than half of it
    off_map_distance2, off_map_scalars    how well the prior field explains the window: a chi-square and its freedom
    missed         at most this probability was left out by the search
    """

    atoms: Atoms
    modes: tuple[BelievedMode, ...]
    best: BelievedMode
    lattice_mass: Array
    log_ratio: float | None
    unmapped: float
    off_map_distance2: float
    off_map_scalars: float
    missed: float


def believe(matched: Matched) -> Belief:
    """Refine, sum and normalise the candidates' posterior."""
    found = matched.candidates
    gaussian = pose_gaussian(matched)
    optima = find_optima(matched, gaussian)
    peak = max(optima[0].objective, float(matched.score[0]))
    # Of candidates alone by their own best: what is refined may be better by more than a float can tell.
    lattice = np.exp(matched.score - matched.score[0])
    relative = np.exp(matched.score - peak)
    cell = np.array([plane.resolution_m for plane in matched.planes])
    untold = untold_variance_m2(matched.window.path_m) + matched.structure.position_sd_m**2
    atoms = cell_atoms(found.plane, found.row, found.column, matched.position_m, relative, cell[found.plane], untold)
    atoms = replace_narrow_modes(atoms, [
        NarrowMode(each.plane, each.fine.pose[0, :2], each.fine.covariance[0, :2, :2],
                   _laplace_mass(matched, gaussian, each, peak), float(cell[each.plane]))
        for each in optima
    ], untold)  # fmt: skip
    total = float(atoms.mass.sum())
    leaders = _leaders(optima)
    share = _mode_masses(atoms, [(each.plane, each.fine.pose[0, :2]) for each in leaders]) / total
    modes = [each.believed(float(mass)) for each, mass in zip(leaders, share, strict=True)]
    best = modes[0]
    if matched.best != 0:  # a feature's
        aligned = _refined(matched, gaussian, np.array([matched.best]))[0]
        nearest = _nearest(atoms, aligned.plane, aligned.fine.pose[0, :2])
        best = aligned.believed(float(atoms.mass[nearest]) / total)
    elsewhere = off_map(matched, peak)
    nowhere, poor = elsewhere.mass / (elsewhere.mass + total), _poorly_measured(matched, lattice)
    atoms.mass = atoms.mass / total
    return Belief(
        atoms=atoms,
        modes=tuple(sorted(modes, key=lambda mode: -mode.probability)),
        best=best,
        lattice_mass=lattice / lattice.sum(),
        log_ratio=log_ratio(optima, matched.options.mlr_min_distance_m),
        unmapped=nowhere + (1.0 - nowhere) * poor,
        off_map_distance2=elsewhere.distance2,
        off_map_scalars=elsewhere.scalars,
        missed=_missed(matched),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """A local optimum of the posterior: `objective` counts the priors in, as the candidates' scores do."""

    plane: int
    fine: Refined
    objective: float

    def believed(self, probability: float) -> BelievedMode:
        fine = self.fine
        return BelievedMode(self.plane, fine.pose[0], float(fine.log_l[0]), float(fine.distance2[0]), probability, fine)


def find_optima(matched: Matched, gaussian: PoseGaussian) -> list[Optimum]:
    """Local optima of the posterior, the best first: refined from the best candidates of every place and heading."""
    starts = distinct_poses(
        matched.candidates.plane, matched.position_m, matched.courses.heading_rad[matched.candidates.course],
        START_APART_M, START_APART_RAD, _STARTS,
    )  # fmt: skip
    kept: list[Optimum] = []
    for each in sorted(_refined(matched, gaussian, starts), key=lambda each: -each.objective):
        pose = each.fine.pose[0]
        again = any(
            each.plane == other.plane
            and np.linalg.norm(pose[:2] - other.fine.pose[0, :2]) < _SAME_M
            and abs(np.angle(np.exp(1j * (pose[2] - other.fine.pose[0, 2])))) < _SAME_RAD
            for other in kept
        )
        if not again:
            kept.append(each)
    return kept


def _refined(matched: Matched, gaussian: PoseGaussian, candidates: NDArray[np.int64]) -> list[Optimum]:
    """Candidates, refined; those of a plane together."""
    found, courses = matched.candidates, matched.courses
    refined = []
    for k, plane in enumerate(matched.planes):
        here = candidates[found.plane[candidates] == k]
        if not len(here):
            continue
        course = found.course[here]
        start = np.column_stack([
            matched.position_m[here], courses.heading_rad[course], courses.scale[course] - 1.0,
            courses.drift_rad_per_m[course],
        ])  # fmt: skip
        floor = matched.floors[matched.plane_floor[k]]
        fine = refine_poses(floor, plane, matched.window, start, gaussian, matched.error)
        height = _height_log(matched, k)
        refined += [Optimum(k, fine.only(m), float(fine.objective[m]) + height) for m in range(len(here))]
    return refined


def _leaders(optima: list[Optimum]) -> list[Optimum]:
    """The best optimum of every place, places MODES_APART_M apart; the best first."""
    leaders: list[Optimum] = []
    for each in optima:
        if len(leaders) < _MODES and not any(_near(each, other, MODES_APART_M) for other in leaders):
            leaders.append(each)
    return leaders


def _near(a: Optimum, b: Optimum, distance_m: float) -> bool:
    return a.plane == b.plane and bool(np.linalg.norm(a.fine.pose[0, :2] - b.fine.pose[0, :2]) < distance_m)


def log_ratio(optima: list[Optimum], apart_m: float) -> float | None:
    """Log ratio of the best optimum to the best one elsewhere (Shockley 8.2); None where nothing else was found."""
    rivals = [each.objective for each in optima if not _near(each, optima[0], apart_m)]
    return optima[0].objective - max(rivals) if rivals else None


def _nearest(atoms: Atoms, plane: int, position_m: Array) -> int:
    distance = np.linalg.norm(atoms.position_m - position_m, axis=1)
    return int(np.argmin(np.where(atoms.plane == plane, distance, np.inf)))


def _missed(matched: Matched) -> float:
    """The share of the posterior the search left out, at most, as it is searched: with inflated variances."""
    scores = matched.candidates.score[np.isfinite(matched.candidates.score)]
    searched = float(np.exp(scores - scores.max()).sum())
    return matched.candidates.missed_mass / (matched.candidates.missed_mass + searched)


def pose_gaussian(matched: Matched) -> PoseGaussian:
    """The prior of a pose, for refinement."""
    window, prior, options = matched.asked, matched.pose_prior, matched.options
    mean, precision, free = np.zeros(POSE), np.zeros(POSE), np.ones(POSE)
    if prior.position_m is not None:
        mean[:2], precision[:2] = prior.position_m[:2], prior.sd_m**-2
    fixed = window.frame == "building" or (window.heading_rad is not None and not window.heading_sd_rad)
    if window.heading_rad is not None and window.heading_sd_rad and not fixed:
        mean[2], precision[2] = window.heading_rad, window.heading_sd_rad**-2
    free[2] = 0.0 if fixed else 1.0
    for k, sd in ((3, options.step_scale_sd), (4, 0.0 if fixed else options.heading_drift_sd_rad_per_m)):
        if sd > 0.0 and len(matched.window) > 1:
            precision[k] = sd**-2
        else:
            free[k] = 0.0
    return PoseGaussian(mean, precision, free)


def _laplace_mass(matched: Matched, gaussian: PoseGaussian, optimum: Optimum, peak: float) -> float:
    """The optimum's mass in units of exp(peak) per pose, as if the lattice were infinitely fine.

    A heading of the lattice weighs exp(log prior), a scale or a drift what its prior holds: theirs have a constant.
    """
    free = gaussian.free.astype(bool)
    covariance = optimum.fine.covariance[0][np.ix_(free, free)]
    step = matched.courses.steps.heading_rad if free[2] else 1.0
    volume = matched.planes[optimum.plane].resolution_m ** 2 * step
    told = float(np.sum(np.log(2.0 * np.pi / gaussian.precision[3:][free[3:]])))
    log_volume = 0.5 * float(np.linalg.slogdet(2 * np.pi * covariance)[1]) - 0.5 * told - np.log(volume)
    return float(np.exp(np.clip(optimum.objective - peak + log_volume, -700, 700)))


def _height_log(matched: Matched, plane: int) -> float:
    prior = matched.pose_prior
    if prior.position_m is None:
        return 0.0
    return float(-0.5 * ((matched.planes[plane].height_m - prior.position_m[2]) / prior.sd_m) ** 2)


def _mode_masses(atoms: Atoms, centres: list[tuple[int, Array]]) -> Array:
    """Mass of each mode (m,): every atom within reach goes to the nearest centre on its plane."""
    if not centres:
        return np.zeros(0)
    distance = np.full((len(centres), len(atoms.mass)), np.inf)
    for k, (plane, centre) in enumerate(centres):
        here = atoms.plane == plane
        distance[k, here] = np.linalg.norm(atoms.position_m[here] - centre, axis=1)
    nearest = np.argmin(distance, axis=0)
    near = distance[nearest, np.arange(len(nearest))] < MODES_APART_M
    return np.asarray(np.bincount(nearest[near], weights=atoms.mass[near], minlength=len(centres)), dtype=np.float64)


def _poorly_measured(matched: Matched, relative: Array) -> float:
    """Share of the mass at poses with fewer than half of the window's samples on measured cells."""
    found = matched.candidates
    heavy = np.arange(min(len(relative), _HEAVY_POSES))  # candidates come by descending score
    poor = 0.0
    for k, plane in enumerate(matched.planes):
        here = heavy[found.plane[heavy] == k]
        if len(here):
            poses = found.course[here], found.row[here], found.column[here]
            known = pose_residuals(plane, matched.turned[k], poses)[2]
            poor += float(relative[here][known.mean(axis=1) < 0.5].sum())
    return poor / float(relative[heavy].sum())
