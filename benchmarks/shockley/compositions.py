"""Shockley's compositions on synthetic roads: what is asked of which map, and how far off the fixes are."""

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np

from app.positioning.sections import (
    Transform,
    detect_anomalies,
    match_anomaly,
    section_starts,
    sections_at,
    sum_of_squares,
)
from app.positioning.techniques import best_stretch_bin, likelihood_rival, normalised_mass
from app.synthetic.roads import (
    EARTH_UT,
    Area,
    Calibration,
    Drive,
    RoadSamples,
    calibrate,
    drive,
    make_roads,
    make_vehicles,
    sampled_by_distance,
    sampled_by_time,
)

SAME_UT, CROSS_UT = 0.265, 0.721  # sigma for a map of the same vehicle, or of another (Shockley, L1043)
MIN_DISTANCE_M, LEAST_RATIO = 20.0, 2.0  # Shockley, L1086
LEAST_SHARE, BIN_M, LEAST_BIN = 0.2, 5.0, 0.7  # ABL's threshold on the likeliest sample, its bin; ours, on the bin
BACKGROUND_M, OUT_UT, MARGIN_M, MOST_RSS_UT = 61, 1.5, 3, 6.0  # of anomalies
VEHICLES = {"T": "truck", "S": "suv", "C": "car"}
AREAS: tuple[Area, ...] = ("rectangle", "neighbourhood", "large")
Technique = Literal["ML", "MLR", "ABL", "ABL by bin", "RSS", "RMS"]
Errors = dict[Technique, np.ndarray]


class Case(NamedTuple):
    """A composition: query and map vehicle, their sampling, samples a section, transform, calibrated or not."""

    pair: str
    query: str = "1 m"
    map: str = "1 m"
    samples: int = 1
    transform: Transform = "raw"
    calibrated: bool = True
    area: Area = "rectangle"
    anomalies: bool = False

    def __str__(self) -> str:
        what = "anomalies" if self.anomalies else f"{self.samples} x"
        words = (self.area, self.pair, what, self.query, "on", self.map, self.transform)
        return " ".join((*words, "cal" if self.calibrated else "uncal"))


class World(NamedTuple):
    """The logs of one drive to map and one to ask, and the calibration, of each vehicle."""

    maps: dict[str, Drive]
    queries: dict[str, Drive]
    calibrations: dict[str, Calibration]


@lru_cache(maxsize=24)
def world(seed: int, area: Area) -> World:
    """An area driven twice by each vehicle. The vehicles of a seed are the same in all areas."""
    rng = np.random.default_rng((seed, AREAS.index(area)))
    roads, vehicles = make_roads(area, rng), make_vehicles(np.random.default_rng(seed))
    calibration_rng = np.random.default_rng((seed, 9))
    calibrations = {name: calibrate(vehicle, EARTH_UT, calibration_rng) for name, vehicle in vehicles.items()}
    maps, queries = ({name: drive(roads, vehicle, rng) for name, vehicle in vehicles.items()} for _ in range(2))
    return World(maps, queries, calibrations)


def sampled(seed: int, area: Area, role: Literal["maps", "queries"], letter: str, how: str, cal: bool) -> RoadSamples:
    """A vehicle's log sampled by "10 Hz" or "1 m"."""
    logs = world(seed, area)
    log: Drive = getattr(logs, role)[VEHICLES[letter]]
    calibration = logs.calibrations[VEHICLES[letter]] if cal else None
    number, unit = how.split()
    if unit == "Hz":
        return sampled_by_time(log, calibration, round(50.0 / float(number)))
    return sampled_by_distance(log, calibration, float(number))


@dataclass(eq=False)
class Study:
    """Cases in several worlds, so many windows in each; every case is computed once."""

    worlds: tuple[int, ...]
    windows: int
    found: dict[tuple[Case, int], Errors] = field(default_factory=dict)

    def errors_m(self, case: Case, seed: int) -> Errors:
        """Miss distances (windows,) of each technique in a world, NaN where it reports no fix."""
        if (case, seed) not in self.found:
            query = sampled(seed, case.area, "queries", case.pair[0], case.query, case.calibrated)
            mapped = sampled(seed, case.area, "maps", case.pair[1], case.map, case.calibrated)
            if case.anomalies:
                self.found[case, seed] = anomaly_errors_m(case, query, mapped)
            else:
                at_m = np.random.default_rng(seed).uniform(20.0, query.along_m[-1] - 10.0, self.windows)
                self.found[case, seed] = section_errors_m(case, query, mapped, at_m)
        return self.found[case, seed]


def section_errors_m(case: Case, query: RoadSamples, mapped: RoadSamples, at_m: np.ndarray) -> Errors:
    """Sections that end at the same places in every composition, against all runs of the map; a fix is a run's end."""
    starts, asked = section_starts(mapped.stretch, case.samples), section_starts(query.stretch, case.samples)
    ends, asked_end = starts + case.samples - 1, asked + case.samples - 1
    chosen = np.clip(np.searchsorted(query.along_m[asked_end], at_m), 0, len(asked) - 1)
    windows = sections_at(query.field_uT, asked[chosen], case.samples)
    sigma_uT = SAME_UT if case.pair[0] == case.pair[1] else CROSS_UT
    log_l = sum_of_squares(windows, mapped.field_uT, starts, case.transform) / (-2.0 * sigma_uT**2)
    place = RoadSamples(mapped.position_m[ends], mapped.field_uT[ends], mapped.along_m[ends], mapped.stretch[ends])
    found = [fixes(each, place) for each in log_l]
    truth = query.position_m[asked_end[chosen]]
    return {name: np.linalg.norm([each[name] for each in found] - truth, axis=1) for name in found[0]}


def fixes(log_l: np.ndarray, place: RoadSamples) -> dict[Technique, np.ndarray]:
    """The position that each technique reports, NaN where none."""
    one_plane, nowhere = np.zeros(len(log_l), dtype=np.int64), np.full(2, np.nan)
    best = int(np.argmax(log_l))
    rival = likelihood_rival(place.position_m, one_plane, log_l, best, MIN_DISTANCE_M)
    mass = normalised_mass(log_l)
    heaviest = best_stretch_bin(mass, place.along_m, place.stretch, place.position_m, BIN_M)
    clear = rival is not None and rival.log_ratio > np.log(LEAST_RATIO)
    return {
        "ML": place.position_m[best],
        "MLR": place.position_m[best] if clear else nowhere,
        "ABL": heaviest.position_m if mass[best] >= LEAST_SHARE else nowhere,
        "ABL by bin": heaviest.position_m if heaviest.mass >= LEAST_BIN else nowhere,
    }


def anomaly_errors_m(case: Case, query: RoadSamples, mapped: RoadSamples) -> dict[Technique, np.ndarray]:
    """Each anomaly of the query's log against those of the map; ML reports all, RSS below a threshold, RMS is ours."""
    known, asked = (
        detect_anomalies(each.field_uT, each.stretch, background=BACKGROUND_M, threshold_uT=OUT_UT, margin=MARGIN_M)
        for each in (mapped, query)
    )
    errors: dict[Technique, list[float]] = {"ML": [], "RSS": [], "RMS": []}
    for anomaly in asked:
        section = query.field_uT[anomaly.first : anomaly.stop]
        by_rss = match_anomaly(section, mapped.field_uT, known, transform=case.transform, by="rss")
        by_rms = match_anomaly(section, mapped.field_uT, known, transform=case.transform, by="rms")
        assert by_rss is not None
        assert by_rms is not None
        miss, miss_rms = (
            float(np.linalg.norm(mapped.position_m[known[m.anomaly].peak] - query.position_m[anomaly.peak]))
            for m in (by_rss, by_rms)
        )
        errors["ML"].append(miss)
        errors["RSS"].append(miss if by_rss.rss_uT <= MOST_RSS_UT else np.nan)
        errors["RMS"].append(miss_rms)
    return {name: np.array(values) for name, values in errors.items()}
