"""The posterior of a matched window: mass of cells, refined modes, and the hypothesis that it is off the map."""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array
from app.positioning.fix import LocateOptions
from app.positioning.lattice import turn_window
from app.positioning.matching import Matched
from app.positioning.off_map import off_map
from app.positioning.posterior import Atoms, cell_atoms, find_modes, replace_narrow_mode, untold_variance_m2
from app.positioning.refine import Refined, refine_poses

__all__ = ["Belief", "BelievedMode", "believe"]

_MODES = 8
_HEAVY_POSES = 2000  # enough poses to judge how much of the window was measured


@dataclass(frozen=True, slots=True, eq=False)
class BelievedMode:
    """One mode: its refined pose (x, y, heading of the window's frame), and mass relative to all poses on maps."""

    plane: int
    pose: Array
    log_l: float
    distance2: float
    probability: float


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


def believe(matched: Matched, options: LocateOptions) -> Belief:
    """Sum, refine and normalise the candidates' tempered posterior."""
    found = matched.candidates
    relative = np.exp((found.score - found.score[0]) / matched.temper)
    cell = np.array([plane.resolution_m for plane in matched.planes])
    untold = untold_variance_m2(matched.window.from_last_m)
    atoms = cell_atoms(found.plane, found.row, found.column, matched.position_m, relative, cell[found.plane], untold)
    members = find_modes(found.plane, matched.position_m, found.score, options.mlr_min_distance_m, _MODES)
    peaks = [int(group[0]) for group in members]
    refined = [_refine(matched, peak) for peak in peaks]
    for peak, fine in zip(peaks, refined, strict=True):
        plane = int(found.plane[peak])
        mass = _laplace_mass(matched, plane, fine)
        atoms = replace_narrow_mode(
            atoms, plane, fine.pose[0, :2], fine.covariance[0, :2, :2], mass, float(cell[plane]), untold
        )
    total = float(atoms.mass.sum())
    share = _mode_masses(atoms, [(int(found.plane[k]), r.pose[0, :2]) for k, r in zip(peaks, refined, strict=True)],
                         options.mlr_min_distance_m) / total  # fmt: skip
    modes = [
        BelievedMode(int(found.plane[k]), r.pose[0], float(r.log_l[0]), float(r.distance2[0]), float(s))
        for k, r, s in zip(peaks, refined, share, strict=True)
    ]
    elsewhere = off_map(matched)
    nowhere, poor = elsewhere.mass / (elsewhere.mass + total), _poorly_measured(matched, relative)
    atoms.mass = atoms.mass / total
    return Belief(
        atoms=atoms,
        modes=tuple(sorted(modes, key=lambda mode: -mode.probability)),
        best=modes[0],
        lattice_mass=relative / relative.sum(),
        unmapped=nowhere + (1.0 - nowhere) * poor,
        off_map_distance2=elsewhere.distance2,
        off_map_scalars=elsewhere.scalars,
        missed=found.missed_mass / (found.missed_mass + total),
    )


def _refine(matched: Matched, candidate: int) -> Refined:
    found, plane = matched.candidates, int(matched.candidates.plane[candidate])
    heading = matched.headings_rad[found.heading[candidate]]
    start = np.array([[*matched.position_m[candidate], heading]])
    floor = matched.floors[matched.plane_floor[plane]]
    return refine_poses(
        floor, matched.planes[plane], matched.window, start, matched.gaussian, matched.temper, matched.demeaned
    )


def _laplace_mass(matched: Matched, plane: int, refined: Refined) -> float:
    """The mode's mass in units of the best pose of the lattice, as if the lattice were infinitely fine."""
    free = matched.gaussian.free.astype(bool)
    covariance = refined.covariance[0][np.ix_(free, free)]
    step = abs(matched.headings_rad[1] - matched.headings_rad[0]) if free[2] else 1.0
    volume = matched.planes[plane].resolution_m ** 2 * step
    height = _height_log(matched, plane)
    peak = np.exp(np.clip((refined.objective[0] - matched.candidates.score[0]) / matched.temper + height, -700, 700))
    return float(peak * np.sqrt(np.linalg.det(2 * np.pi * covariance)) / volume)


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
        if not len(here):
            continue
        turned = turn_window(matched.window, matched.headings_rad, plane.resolution_m)
        cells = (
            np.stack([found.row[here], found.column[here]], axis=1)[:, None] + turned.offset_cells[found.heading[here]]
        )
        ny, nx = plane.shape
        inside = (cells >= 0).all(axis=2) & (cells[..., 0] < ny) & (cells[..., 1] < nx)
        known = inside & plane.measured[cells[..., 0].clip(0, ny - 1), cells[..., 1].clip(0, nx - 1)]
        poor += float(relative[here][known.mean(axis=1) < 0.5].sum())
    return poor / float(relative[heavy].sum())
