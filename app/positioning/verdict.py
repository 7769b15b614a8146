"""From a belief to an answer: the estimates of the techniques, the posterior's figures, and a plain status."""

from collections.abc import Sequence

import numpy as np

from app.geometry import Array
from app.positioning.ambiguity import FARTHEST_M, walk_further
from app.positioning.belief import Belief
from app.positioning.estimates import abl_estimate, contour_estimate, mad_estimate, ml_estimate, mlr_estimate
from app.positioning.fix import (
    AblEstimate,
    ContourEstimate,
    Fix,
    LocateOptions,
    MadEstimate,
    MlrEstimate,
    Mode,
    Posterior,
    Status,
)
from app.positioning.matching import Matched
from app.positioning.misfit import misfit, residual_rms_uT
from app.positioning.posterior import mass_radius, mixture_points
from app.positioning.techniques import chi_square_limit

__all__ = ["conclude"]

_CERTAIN = 0.9  # a fix has one mode with at least this probability, off the map and what was missed counted in
_OFF = 0.6  # from this probability on a window is unmapped: beforehand it is a half, and that is no finding
_MISSED = 0.05  # beyond this share of missed mass a radius of 95 % cannot be stated from the rest


def conclude(matched: Matched, belief: Belief, techniques: Sequence[str], options: LocateOptions) -> Fix:
    """Estimates, posterior and status of a belief."""
    status, reason = _status(matched, belief, options)
    not_asked = "not asked for"
    mad = MadEstimate(False, reason=not_asked)
    contour = ContourEstimate(False, reason=not_asked)
    if {"mad", "contour"} & set(techniques):
        mad = mad_estimate(matched, options)
    if "contour" in techniques:
        contour = contour_estimate(matched, mad)
    return Fix(
        status=status,
        reason=reason,
        ml=ml_estimate(matched, belief),
        mlr=mlr_estimate(matched, belief, options)
        if "mlr" in techniques
        else MlrEstimate(False, None, reason=not_asked),
        abl=abl_estimate(matched, belief, options) if "abl" in techniques else AblEstimate(False, reason=not_asked),
        mad=mad,
        contour=contour,
        posterior=_posterior(matched, belief),
    )


def _posterior(matched: Matched, belief: Belief) -> Posterior:
    ids = [floor.floor_id for floor in matched.floors]
    floor_of = matched.plane_floor[belief.atoms.plane]
    probability = np.bincount(floor_of, weights=belief.atoms.mass, minlength=len(ids))
    strongest = int(np.argmax(probability))
    here = belief.atoms.on(floor_of == strongest)
    heaviest = int(np.argmax(here.mass))
    peaks = [(mode.plane, mode.pose[:2]) for mode in belief.modes if matched.plane_floor[mode.plane] == strongest]
    # Modes are the most likely places; a floor may be the strongest by the sum of many lesser ones.
    plane, peak = peaks[0] if peaks else (int(here.plane[heaviest]), here.position_m[heaviest])
    points, mass = mixture_points(here)
    centre = _mode_mean(points, mass, peak)
    radii = mass_radius(points, mass, centre, (0.5, 0.68, 0.9, 0.95))
    off = points - centre
    covariance = np.asarray((mass * off.T) @ off / mass.sum())
    if (
        belief.unmapped > _OFF or _unweighed(matched, belief) > _MISSED
    ):  # what was weighed says little of where the window may be
        radii = (_searched_radius_m(matched, strongest, centre),) * 4
        covariance = _searched_covariance_m2(matched, strongest, centre)
    return Posterior(
        floor_probability={floor_id: float(p) for floor_id, p in zip(ids, probability, strict=True)},
        floor_id=ids[strongest],
        position_m=matched.place(plane, centre),
        covariance_m2=covariance,
        radius_50_m=radii[0],
        radius_68_m=radii[1],
        radius_90_m=radii[2],
        radius_95_m=radii[3],
        modes=tuple(
            Mode(
                matched.floor_id(mode.plane), matched.place(mode.plane, mode.pose),
                matched.device_heading_rad(mode.pose), mode.probability,
            )
            for mode in belief.modes
        ),
        off_map_probability=belief.unmapped,
        missed_probability=belief.missed,
    )  # fmt: skip


def _status(matched: Matched, belief: Belief, options: LocateOptions) -> tuple[Status, str | None]:
    flat = matched.error.offset_precision == 0.0
    scalars = matched.window.features_uT.size - (matched.window.features_uT.shape[1] if flat else 0)
    distance2 = belief.best.distance2
    limit = chi_square_limit(scalars, options.gate_probability)
    unlike_any_field = belief.off_map_distance2 > chi_square_limit(belief.off_map_scalars, options.gate_probability)
    if belief.unmapped > _OFF and not (unlike_any_field and distance2 > limit):
        weighed = "not all of the map was weighed, but " if _unweighed(matched, belief) > 0.5 else ""
        return "unmapped", (
            f"{weighed}the window fits ground without a map at least as well (probability {belief.unmapped:.2f}); walk "
            "on into mapped corridors, or survey where this was recorded; if it was recorded on mapped ground, "
            "calibrate the magnetometer or use composition demeaned"
        )
    rms_uT, most_uT = residual_rms_uT(matched, belief.best.refined), options.feature_rms_uT
    if matched.composition == "feature" and most_uT is not None and rms_uT > most_uT:
        return "inconsistent", (
            f"no feature of the map is like this one: the best differs by {rms_uT:.1f} uT rms, not {most_uT:g}; walk "
            "on to another, or use composition raw"
        )
    if distance2 > limit:
        where = misfit(matched, belief)
        return "inconsistent", (
            f"even the best match is worse than chance allows (chi-square {distance2:.1f}, limit {limit:.1f}"
            f"{'; ' if where else ''}{where}); check units, frame and calibration, or whether the building changed "
            "since the survey; composition demeaned removes an offset"
        )
    if _unweighed(matched, belief) > 0.5:
        return "ambiguous", (
            "the window matches so many places that not all of them were weighed; walk further, or send a prior "
            "position or heading"
        )
    strongest = belief.modes[0].probability * (1.0 - belief.unmapped) * (1.0 - _unweighed(matched, belief))
    if strongest < _CERTAIN:
        return "ambiguous", (
            f"the strongest place holds only {strongest:.2f} of the probability; {_advice(matched, belief)}, or send a "
            "prior position or heading"
        )
    return "fix", None


def _advice(matched: Matched, belief: Belief) -> str:
    """How much farther to walk, if the map can tell."""
    further = walk_further(matched, belief)
    if further is None:
        return "walk further or turn a corner"
    places = "one other place is" if further.rivals == 1 else f"{further.rivals} other places are"
    apart = "" if further.apart_m is None else f" (the nearest {further.apart_m:.0f} m away)"
    if further.distance_m is None:
        return (
            f"{places} as likely{apart} and alike straight ahead for {FARTHEST_M:.0f} m: walk further and turn a corner"
        )
    distance_m = np.ceil(further.distance_m)
    return f"{places} nearly as likely{apart}; walk further, about {distance_m:.0f} m straight ahead, to tell"


def _unweighed(matched: Matched, belief: Belief) -> float:
    """The share of the mass that may have been missed because too many poses qualified; a bound, and often a loose one.

    A complete search left out only poses far below the best: their bound is no evidence that they matter.
    """
    return 0.0 if matched.candidates.complete else belief.missed


def _searched_box_m(matched: Matched, floor: int) -> tuple[Array, Array]:
    """Lowest and highest corner (2,) of what was searched on a floor."""
    planes = [plane for plane, on in zip(matched.planes, matched.plane_floor, strict=True) if on == floor]
    low = np.array([plane.origin_m for plane in planes])
    cells = np.array([plane.shape[::-1] for plane in planes])
    extent = np.array([plane.resolution_m for plane in planes])[:, None] * (cells - 1)
    return low.min(axis=0), (low + extent).max(axis=0)


def _searched_radius_m(matched: Matched, floor: int, centre_m: Array) -> float:
    low, high = _searched_box_m(matched, floor)
    return float(np.linalg.norm(np.maximum(centre_m - low, high - centre_m)))


def _searched_covariance_m2(matched: Matched, floor: int, centre_m: Array) -> Array:
    """Second moment (2, 2) about `centre_m` of a uniform density over what was searched."""
    low, high = _searched_box_m(matched, floor)
    mean = 0.5 * (low + high) - centre_m
    return np.asarray(np.diag(np.square(high - low) / 12.0) + np.outer(mean, mean))


def _mode_mean(points_m: Array, mass: Array, peak_m: Array) -> Array:
    """Mean of the mass about a peak: within the radius that keeps the mode apart from others, itself if nothing is."""
    near = np.linalg.norm(points_m - peak_m, axis=1) < 2.0
    return np.asarray(mass[near] @ points_m[near] / mass[near].sum()) if near.any() else peak_m
