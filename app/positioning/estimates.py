"""The techniques' answers from a matched window: ML, MLR, ABL (Shockley 8.1-8.3), MAD, contour (Cuenca 1.10, 1.11)."""

import numpy as np

from app.geometry import Array
from app.positioning.belief import Belief
from app.positioning.contour import contour_tolerance_uT, nearest_on_contour
from app.positioning.fix import AblEstimate, ContourEstimate, LocateOptions, MadEstimate, MlEstimate, MlrEstimate
from app.positioning.floors import Plane
from app.positioning.mad import least_deviation, mean_absolute_deviation
from app.positioning.matching import Matched
from app.positioning.misfit import residual_rms_uT
from app.positioning.scoring import pose_residuals
from app.positioning.techniques import best_bin, peak_over_uniform

__all__ = ["abl_estimate", "contour_estimate", "mad_estimate", "ml_estimate", "mlr_estimate"]

_MAD_CANDIDATES = 20_000  # the likeliest: a pose of small deviation is one of small squares
_CONTOUR_REACH_M = 5.0


def ml_estimate(matched: Matched, belief: Belief) -> MlEstimate:
    """The most likely pose, refined; of a feature the most likely with its peak on one of the map's."""
    best = belief.best
    unscaled = best.log_l + len(matched.window) * float(np.log(matched.window.scale).sum())
    return MlEstimate(
        matched.floor_id(best.plane), matched.place(best.plane, best.pose), matched.device_heading_rad(best.pose),
        unscaled, residual_rms_uT(matched, best.refined),
    )  # fmt: skip


def mlr_estimate(matched: Matched, belief: Belief, options: LocateOptions) -> MlrEstimate:
    """The most likely pose, if it is enough likelier than the best one elsewhere."""
    far = options.mlr_min_distance_m
    if not _anything_beyond(matched, far):
        return MlrEstimate(
            False, None, reason=f"the map ends within {far:g} m of the best match: no rival to compare with"
        )
    log_ratio = matched.candidates.window_nats if belief.log_ratio is None else belief.log_ratio
    ratio = float(np.exp(min(log_ratio, 700.0)))
    if not ratio > options.mlr_ratio:
        reason = f"a place {far:g} m away or more matches nearly as well: ratio {ratio:.2f}, not {options.mlr_ratio:g}"
        return MlrEstimate(False, ratio, reason=reason)
    best = belief.best
    return MlrEstimate(True, ratio, matched.floor_id(best.plane), matched.place(best.plane, best.pose))


def abl_estimate(matched: Matched, belief: Belief, options: LocateOptions) -> AblEstimate:
    """The mean place of the heaviest bin, if it holds enough of the likelihood."""
    found, mass = matched.candidates, belief.lattice_mass
    strongest, winner, lead = None, 0, -1.0
    tables, cells = [], sum(plane.shape[0] * plane.shape[1] for plane in matched.planes)
    for k in np.unique(found.plane):
        here, plane = found.plane == k, matched.planes[k]
        row0, column0 = found.row[here].min(), found.column[here].min()
        table = np.zeros((found.row[here].max() - row0 + 1, found.column[here].max() - column0 + 1))
        np.add.at(table, (found.row[here] - row0, found.column[here] - column0), mass[here])
        tables.append(table.ravel())
        held = best_bin(table, max(round(options.abl_bin_m / plane.resolution_m), 1))
        if held.mass > lead:
            lead, winner = held.mass, int(k)
            strongest = (column0 + held.column, row0 + held.row)
    multiple = peak_over_uniform(np.concatenate(tables), cells)
    if options.abl_threshold is not None and multiple < options.abl_threshold:
        wanted = f"not {options.abl_threshold:g}"
        reason = f"the likelihood is spread out: its peak is {multiple:.3g} times the uniform share, {wanted}"
        return AblEstimate(False, lead, multiple, reason=reason)
    if lead < options.abl_min_probability or strongest is None:
        reason = (
            f"the likelihood is spread out: its heaviest {options.abl_bin_m:g} m hold {lead:.2f} of it, not "
            f"{options.abl_min_probability:g}"
        )
        return AblEstimate(False, lead, multiple, reason=reason)
    plane = matched.planes[winner]
    place = np.array(plane.origin_m) + plane.resolution_m * np.array(strongest)
    return AblEstimate(True, lead, multiple, matched.floor_id(winner), matched.place(winner, place))


def mad_estimate(matched: Matched, options: LocateOptions) -> MadEstimate:
    """The likely pose whose norms differ least, on average, from the map's: no rotation has to be known for it."""
    count = min(len(matched.score), _MAD_CANDIDATES)
    deviation = np.full(count, np.nan)
    found, scale = matched.candidates, matched.window.scale
    for k, plane in enumerate(matched.planes):
        here = np.flatnonzero(found.plane[:count] == k)
        if len(here):
            poses = found.course[here], found.row[here], found.column[here]
            residual, _, measured = pose_residuals(plane, matched.turned[k], poses)
            window_uT = np.linalg.norm(matched.turned[k].features_uT[poses[0]] / scale, axis=2)
            map_uT = np.linalg.norm((matched.turned[k].features_uT[poses[0]] - residual) / scale, axis=2)
            apart = np.where(measured, window_uT - map_uT, np.nan)
            deviation[here] = mean_absolute_deviation(apart[..., None])
    apart_m = 1e6 * matched.plane_floor[found.plane[:count]]  # floors are far from each other, whatever their places
    places = np.column_stack([matched.position_m[:count], apart_m])
    best = least_deviation(deviation, places, options.mlr_min_distance_m)
    if best is None:
        return MadEstimate(False, reason="less than half of the window lies on measured ground wherever it is likely")
    plane_index = int(found.plane[best.candidate])
    place = matched.place(plane_index, matched.position_m[best.candidate])
    return MadEstimate(True, best.mad_uT, float(min(best.ratio, 1e12)), matched.floor_id(plane_index), place)


def contour_estimate(matched: Matched, mad: MadEstimate) -> ContourEstimate:
    """The MAD estimate moved to the nearest place whose norm is the last reading's."""
    if mad.position_m is None:
        return ContourEstimate(False, reason=mad.reason)
    x, y, z = mad.position_m
    k = next(k for k, plane in enumerate(matched.planes) if matched.floor_id(k) == mad.floor_id and plane.height_m == z)
    plane = matched.planes[k]
    norm_uT = _norm_uT(plane)
    last_uT = float(np.linalg.norm(matched.window.features_uT[-1] / matched.window.scale))
    sigma_uT = float(np.sqrt(plane.typical_variance_uT2))
    start = (y - plane.origin_m[1]) / plane.resolution_m, (x - plane.origin_m[0]) / plane.resolution_m
    tolerance = contour_tolerance_uT(norm_uT, plane.resolution_m, sigma_uT)
    point = nearest_on_contour(norm_uT, start, last_uT, tolerance, _CONTOUR_REACH_M / plane.resolution_m)
    if point is None:
        return ContourEstimate(
            False, reason=f"no place within {_CONTOUR_REACH_M:g} m of the MAD estimate has the last reading's norm"
        )
    place = np.array(plane.origin_m) + plane.resolution_m * np.array([point.column, point.row])
    moved_m = point.distance_cells * plane.resolution_m
    return ContourEstimate(True, moved_m, mad.floor_id, matched.place(k, place))


def _norm_uT(plane: Plane) -> Array:
    """(ny, nx) norm of the map, NaN where it was not measured."""
    mean = plane.mean_uT[1:-1, 1:-1].astype(np.float64) / plane.scale
    return np.where(plane.measured, np.linalg.norm(mean, axis=-1), np.nan)


def _anything_beyond(matched: Matched, distance_m: float) -> bool:
    if len(matched.planes) > 1:
        return True
    plane = matched.planes[0]
    extent = plane.resolution_m * (np.array(plane.shape[::-1]) - 1)
    from_origin = matched.position_m[matched.best] - np.array(plane.origin_m)
    return bool(np.linalg.norm(np.maximum(from_origin, extent - from_origin)) >= distance_m)
