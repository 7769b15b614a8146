"""MagNavigate on synthetic roads: what is fed to the filter, and how far off it is."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from app.geometry import Array
from app.positioning.sections import Transform, section_starts, sections_at, sum_of_squares, travelled_m
from app.synthetic.roads import (
    Area,
    Calibration,
    RoadSamples,
    Vehicle,
    make_vehicles,
    sampled_by_distance,
)
from app.tracking.constraints import RoadPenalty
from app.tracking.magnavigate import MagNavigate, begin_around
from shockley.compositions import CROSS_UT, SAME_UT, VEHICLES, fixes, world

TRAINING = 1  # the world that sds of position updates are taken from
HOLD_S = 0.5  # longest step where standing is known
REPEAT_SAME_UT, REPEAT_CROSS_UT = 0.68, 1.03  # his statistic (Shockley 6.4) of these roads: docs/shockley.md
ALIKE_OVER_M = 10.0  # errors against a map are those of features, which are this long (Shockley, L1057)
Update = Literal["field", "ML", "MLR", "ABL"]
Correction = Literal["none", "simple", "modified"]


class Nav(NamedTuple):
    """A navigation case: query and map vehicle, spacing, what updates the filter, and the calibration of both sides.

    free: time runs on while the vehicle stands, as in the source; else a step lasts half a second at most.
    """

    pair: str
    spacing: str = "1 m"
    update: Update = "field"
    samples: int = 1
    transform: Transform = "raw"
    calibration: Correction = "modified"
    area: Area = "rectangle"
    free: bool = False
    his_sigma: bool = False

    def __str__(self) -> str:
        what = self.update if self.update == "field" else f"{self.update} of {self.samples} x {self.transform}"
        more = ", stops free" * self.free + ", his sigma" * self.his_sigma
        return f"{self.pair} {self.spacing} {what}, {self.calibration}{more}"

    @property
    def field_sd_uT(self) -> float:
        """Of single readings: his table's, or these roads' own, as many times larger as errors that hang together ask.

        Readings nearer than the length of a feature err alike: so many count as one.
        """
        same = self.pair[0] == self.pair[1]
        if self.his_sigma:
            return SAME_UT if same else CROSS_UT
        spacing_m = float(self.spacing.split()[0])
        return (REPEAT_SAME_UT if same else REPEAT_CROSS_UT) * np.sqrt(max(ALIKE_OVER_M / spacing_m, 1.0))


class Track(NamedTuple):
    """Per sample of the query: error (k,) m, elapsed (k,) s, along (k,) m; update there or not (k,); and whether the
    map's reading where the filter is fits better than where the vehicle is, over ten samples (k,)."""

    error_m: Array
    elapsed_s: Array
    along_m: Array
    updated: Array
    fits_better: Array


def simple(vehicle: Vehicle, modified: Calibration) -> Calibration:
    """The "swinging" calibration: a scale per horizontal axis and offsets, no cross terms (Shockley 3.3).

    In closed form, as `calibrate`; the offset and its error are the modified one's.
    """
    rows = np.linalg.norm(vehicle.soft_iron[:2, :2], axis=1)
    return Calibration(np.diag([1.0 / rows[0], 1.0 / rows[1], 1.0]), modified.offset_uT)


@dataclass(eq=False)
class Drives:
    """Cases in several worlds; each is run once, from a seed of its world."""

    worlds: tuple[int, ...]
    particles: int = 500
    found: dict[tuple[Nav, int], Track] = field(default_factory=dict)

    def track(self, nav: Nav, seed: int) -> Track:
        if (nav, seed) not in self.found:
            self.found[nav, seed] = navigate(nav, seed, self.particles)
        return self.found[nav, seed]

    def rms_m(self, nav: Nav) -> Array:
        """(worlds,) RMS errors."""
        return np.array([np.sqrt(np.mean(np.square(self.track(nav, seed).error_m))) for seed in self.worlds])


def samples_of(nav: Nav, seed: int, role: Literal["maps", "queries"], letter: str) -> tuple[RoadSamples, Array]:
    """A log by distance, and the time (m,) of each sample."""
    logs, name = world(seed, nav.area), VEHICLES[letter]
    log = getattr(logs, role)[name]
    vehicle, modified = make_vehicles(np.random.default_rng(seed))[name], logs.calibrations[name]
    calibration = {"none": None, "modified": modified, "simple": simple(vehicle, modified)}[nav.calibration]
    found = sampled_by_distance(log, calibration, float(nav.spacing.split()[0]))
    along_m, _ = travelled_m(log.t_s, log.recorded_m, slowest_m_s=0.2)
    return found, np.interp(found.along_m, along_m, log.t_s)


def position_fixes(nav: Nav, query: RoadSamples, mapped: RoadSamples) -> Array:
    """(k, 2) position fixes of the sections that end at each sample of the query, NaN where there is none."""
    starts, asked = section_starts(mapped.stretch, nav.samples), section_starts(query.stretch, nav.samples)
    ends = starts + nav.samples - 1
    sigma_uT = SAME_UT if nav.pair[0] == nav.pair[1] else CROSS_UT
    windows = sections_at(query.field_uT, asked, nav.samples)
    log_l = sum_of_squares(windows, mapped.field_uT, starts, nav.transform) / (-2.0 * sigma_uT**2)
    place = RoadSamples(mapped.position_m[ends], mapped.field_uT[ends], mapped.along_m[ends], mapped.stretch[ends])
    found = np.full((len(query.along_m), 2), np.nan)
    found[asked + nav.samples - 1] = [fixes(each, place)[nav.update] for each in log_l]  # type: ignore[index]
    return found


@lru_cache
def fix_sd_m(nav: Nav) -> float:
    """RMS error per axis of a case's fixes in the training world; the source gives no sd for position updates."""
    (query, _), (mapped, _) = (
        samples_of(nav, TRAINING, role, letter) for role, letter in zip(("queries", "maps"), nav.pair, strict=True)
    )
    error_m = position_fixes(nav, query, mapped) - query.position_m
    return float(np.sqrt(np.nanmean(np.square(error_m))))


def navigate(nav: Nav, seed: int, count: int) -> Track:
    """One drive of the query vehicle along the map of the other."""
    (query, t_s), (mapped, _) = (
        samples_of(nav, seed, role, letter) for role, letter in zip(("queries", "maps"), nav.pair, strict=True)
    )
    sd_m = fix_sd_m(nav) if nav.update != "field" else 1.0
    road = RoadPenalty.of(mapped.position_m)
    filter_ = MagNavigate(road, mapped.field_uT, np.full(3, nav.field_sd_uT), position_sd_m=sd_m)
    rng = np.random.default_rng((seed, 77))
    particles = begin_around(query.position_m[0], rng, count)
    places = position_fixes(nav, query, mapped) if nav.update != "field" else None
    elapsed_s = np.diff(t_s, prepend=t_s[0])
    mean_m, updated = np.empty_like(query.position_m), np.ones(len(t_s), dtype=np.bool_)
    for k, reading in enumerate(query.field_uT):
        told: dict[str, Array] = {}
        if places is None:
            told = {"reading_uT": reading}
        elif np.isfinite(places[k, 0]):
            told = {"position_m": places[k]}
        updated[k] = bool(told)
        step_s = elapsed_s[k] if nav.free else min(elapsed_s[k], HOLD_S)
        found = filter_.step(particles, step_s, rng, **told)
        particles, mean_m[k] = found.particles, found.estimate.mean[:2]
    misfit = [
        np.sum(np.square(query.field_uT - mapped.field_uT[road.nearest(at)[1]]), axis=1)
        for at in (mean_m, query.position_m)
    ]
    window = np.ones(10)
    here, there = (np.convolve(each, window)[: len(each)] for each in misfit)
    error_m = np.linalg.norm(mean_m - query.position_m, axis=1)
    return Track(error_m, elapsed_s, query.along_m, updated, here < there)
