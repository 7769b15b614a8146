"""The posterior of a matched window: mass of cells, refined modes, and the hypothesis that it is off the map."""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array
from app.positioning.matching import Matched
from app.positioning.off_map import off_map
from app.positioning.posterior import Atoms, cell_atoms, find_modes, replace_narrow_mode, untold_variance_m2
from app.positioning.refine import POSE, PoseGaussian, Refined, refine_poses
from app.positioning.scoring import pose_residuals

__all__ = ["Belief", "BelievedMode", "believe"]

_MODES = 8
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

    lattice_mass   (n,) share of each candidate pose, as the techniques take them
    unmapped       probability that nothing is mapped where the window was walked, or less than half of it
    off_map_distance2, off_map_scalars    how well the prior field explains the window: a chi-square and its freedom
    missed         at most this probability was left out by the search
    """

    atoms: Atoms
    modes: tuple[BelievedMode, ...]
    best: BelievedMode
    lattice_mass: Array
    unmapped: float
    off_map_distance2: float
    off_map_scalars: float
    missed: float


def believe(matched: Matched) -> Belief:
    """Sum, refine and normalise the candidates' posterior."""
    found, options = matched.candidates, matched.options
    relative = np.exp(matched.score - matched.score[0])
    cell = np.array([plane.resolution_m for plane in matched.planes])
    untold = untold_variance_m2(matched.window.path_m)
    atoms = cell_atoms(found.plane, found.row, found.column, matched.position_m, relative, cell[found.plane], untold)
    members = find_modes(found.plane, matched.position_m, matched.score, options.mlr_min_distance_m, _MODES)
    peaks = [int(group[0]) for group in members]
    gaussian = pose_gaussian(matched)
    refined = [_refine(matched, gaussian, peak) for peak in peaks]
    for peak, fine in zip(peaks, refined, strict=True):
        plane = int(found.plane[peak])
        mass = _laplace_mass(matched, gaussian, plane, fine)
        atoms = replace_narrow_mode(
            atoms, plane, fine.pose[0, :2], fine.covariance[0, :2, :2], mass, float(cell[plane]), untold
        )
    total = float(atoms.mass.sum())
    share = _mode_masses(atoms, [(int(found.plane[k]), r.pose[0, :2]) for k, r in zip(peaks, refined, strict=True)],
                         options.mlr_min_distance_m) / total  # fmt: skip
    modes = [
        BelievedMode(int(found.plane[k]), r.pose[0], float(r.log_l[0]), float(r.distance2[0]), float(s), r)
        for k, r, s in zip(peaks, refined, share, strict=True)
    ]
    best = modes[0]
    if matched.best != 0:
        fine = _refine(matched, gaussian, matched.best)
        best = BelievedMode(int(found.plane[matched.best]), fine.pose[0], float(fine.log_l[0]), float(fine.distance2[0]),
                            float(atoms.mass[_nearest(atoms, int(found.plane[matched.best]), fine.pose[0, :2])]) / total,
                            fine)  # fmt: skip
    elsewhere = off_map(matched)
    nowhere, poor = elsewhere.mass / (elsewhere.mass + total), _poorly_measured(matched, relative)
    atoms.mass = atoms.mass / total
    return Belief(
        atoms=atoms,
        modes=tuple(sorted(modes, key=lambda mode: -mode.probability)),
        best=best,
        lattice_mass=relative / relative.sum(),
        unmapped=nowhere + (1.0 - nowhere) * poor,
        off_map_distance2=elsewhere.distance2,
        off_map_scalars=elsewhere.scalars,
        missed=_missed(matched, total),
    )


def _nearest(atoms: Atoms, plane: int, position_m: Array) -> int:
    distance = np.linalg.norm(atoms.position_m - position_m, axis=1)
    return int(np.argmin(np.where(atoms.plane == plane, distance, np.inf)))


def _missed(matched: Matched, total: float) -> float:
    """The share of the posterior the search left out, at most, as it is searched: with inflated variances."""
    scores = matched.candidates.score[np.isfinite(matched.candidates.score)]
    searched = np.exp(scores - scores.max())
    return matched.candidates.missed_mass / (matched.candidates.missed_mass + float(searched.sum()))


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


def _refine(matched: Matched, gaussian: PoseGaussian, candidate: int) -> Refined:
    found, courses, plane = matched.candidates, matched.courses, int(matched.candidates.plane[candidate])
    k = int(found.course[candidate])
    course = courses.heading_rad[k], courses.scale[k] - 1.0, courses.drift_rad_per_m[k]
    start = np.array([[*matched.position_m[candidate], *course]])
    floor = matched.floors[matched.plane_floor[plane]]
    return refine_poses(floor, matched.planes[plane], matched.window, start, gaussian, matched.error)


def _laplace_mass(matched: Matched, gaussian: PoseGaussian, plane: int, refined: Refined) -> float:
    """The mode's mass in units of the best pose of the lattice, as if the lattice were infinitely fine.

    A heading of the lattice weighs exp(log prior), a scale or a drift what its prior holds: their priors have a constant.
    """
    free = gaussian.free.astype(bool)
    covariance = refined.covariance[0][np.ix_(free, free)]
    step = matched.courses.steps.heading_rad if free[2] else 1.0
    volume = matched.planes[plane].resolution_m ** 2 * step
    told = float(np.sum(np.log(2.0 * np.pi / gaussian.precision[3:][free[3:]])))
    log_volume = 0.5 * float(np.linalg.slogdet(2 * np.pi * covariance)[1]) - 0.5 * told - np.log(volume)
    peak = refined.objective[0] - matched.score[0] + _height_log(matched, plane) + log_volume
    return float(np.exp(np.clip(peak, -700, 700)))


def _height_log(matched: Matched, plane: int) -> float:
    prior = matched.pose_prior
    if prior.position_m is None:
        return 0.0
    return float(-0.5 * ((matched.planes[plane].height_m - prior.position_m[2]) / prior.sd_m) ** 2)


def _mode_masses(atoms: Atoms, centres: list[tuple[int, Array]], reach_m: float) -> Array:
    """Mass of each mode (m,): every atom within reach goes to the nearest centre on its plane."""
    if not centres:
        return np.zeros(0)
    distance = np.full((len(centres), len(atoms.mass)), np.inf)
    for k, (plane, centre) in enumerate(centres):
        here = atoms.plane == plane
        distance[k, here] = np.linalg.norm(atoms.position_m[here] - centre, axis=1)
    nearest = np.argmin(distance, axis=0)
    near = distance[nearest, np.arange(len(nearest))] < reach_m
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
