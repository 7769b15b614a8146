"""Regions out of date: errors made to order over many seeds, and metal moved in the analytic building."""

from dataclasses import replace

import numpy as np
import pytest

from app.field.drift import out_of_date_regions
from app.field.fit import fit_map
from app.field.leave_one_out import HeldOut
from app.field.observations import Walk
from app.field.spec import MapSpec
from app.synthetic import (
    DEVICE_HEIGHT_M,
    Dipoles,
    Magnetometer,
    SyntheticBuilding,
    lawn_mower,
    make_building,
    ornstein_uhlenbeck,
    survey,
)

NAMES = ("bx", "by", "bz")
CORRELATION_M = 1.5
SPOT = np.array([14.0, 8.0])


def lanes(survey_id, index, width_m=24.0, depth_m=18.0):
    """Observations every 20 cm on lanes two metres apart, alternately along x and along y."""
    long, wide = (width_m, depth_m) if index % 2 == 0 else (depth_m, width_m)
    along = np.arange(0.0, long, 0.2)
    across = np.arange(0.3 * (index % 5), wide, 2.0)
    p = np.concatenate([np.column_stack([along, np.full(len(along), offset)]) for offset in across])
    p = np.column_stack([p if index % 2 == 0 else p[:, ::-1], np.zeros(len(p))])
    n = len(p)
    return Walk(survey_id, p, np.zeros((n, 3)), 0.2 * np.arange(n), np.zeros(3), np.zeros((n, 3)), np.arange(n))


def world(seed, early=4, late=2, change_uT=(0.0, 0.0, 5.0), radius_m=2.5):
    """Surveys with offsets and correlated errors; late ones see `change_uT` more near SPOT. The map holds both."""
    rng = np.random.default_rng(seed)
    walks = [lanes(f"s{k}", k) for k in range(early + late)]
    held_out = {}
    for k, walk in enumerate(walks):
        error = ornstein_uhlenbeck(rng, walk.path_m, 0.8, CORRELATION_M, 3) + rng.normal(0.0, 0.3, 3)
        error += 0.4 * rng.normal(size=error.shape)
        near = np.hypot(*(walk.position_m[:, :2] - SPOT).T) < radius_m
        others_late = (late - (k >= early)) / (early + late - 1)
        error[near] += ((k >= early) - others_late) * np.array(change_uT)
        held_out[walk.survey_id] = HeldOut(error, np.ones_like(error), np.ones(len(walk), dtype=bool), walk.path_m)
    return walks, held_out


def regions(walks, held_out, order=None):
    return out_of_date_regions(walks, held_out, order or [w.survey_id for w in walks], NAMES, CORRELATION_M)


def covers(region, point_m):
    x0, y0, x1, y1 = region.bounds_m
    return x0 <= point_m[0] <= x1 and y0 <= point_m[1] <= y1


@pytest.mark.parametrize(("early", "late"), [(4, 2), (2, 1), (2, 4)])
def test_a_change_is_found_where_it_is_with_its_size_and_its_surveys(early, late):
    found = [regions(*world(seed, early, late)) for seed in range(10)]
    assert sum(len(each) == 1 for each in found) >= 9
    right = [each[0] for each in found if each and covers(each[0], SPOT)]
    assert len(right) >= 9
    assert all("bz" in region.components for region in right)
    assert np.median([region.change_ut[2] for region in right]) == pytest.approx(5.0, abs=1.5)
    named = {(region.surveys_before, region.surveys_after) for region in right}
    names = tuple(f"s{k}" for k in range(early + late))
    assert (names[:early], names[early:]) in named
    assert all(np.ptp(region.bounds_m[::2]) <= 9.0 and np.ptp(region.bounds_m[1::2]) <= 9.0 for region in right)


def test_an_unchanged_floor_raises_hardly_any_false_alarm():
    alarms = sum(bool(regions(*world(seed, change_uT=(0.0, 0.0, 0.0)))) for seed in range(60))
    assert alarms <= 2  # one in a hundred is asked for


def test_the_order_of_time_decides():
    walks, held_out = world(0)
    assert regions(walks, held_out)
    mixed = ["s4", "s0", "s1", "s5", "s2", "s3"]  # the two that disagree are neither the newest nor on one side
    assert not regions(walks, held_out, mixed)


def test_a_recent_survey_that_is_off_everywhere_is_not_drift():
    for seed in range(5):
        walks, held_out = world(seed, change_uT=(0.0, 0.0, 0.0))
        bad = held_out["s5"]
        swing = 6.0 * np.sin(walks[5].position_m[:, :2] @ [[0.5, 0.3, 0.2], [0.2, 0.5, 0.4]])
        offset = HeldOut(bad.error_uT + 8.0, bad.sd_uT, bad.judged, bad.path_m)
        turned = HeldOut(bad.error_uT + swing, bad.sd_uT, bad.judged, bad.path_m)
        assert not regions(walks, held_out | {"s5": offset})
        assert not regions(walks, held_out | {"s5": turned})


def test_older_surveys_that_disagree_among_themselves_prove_nothing():
    walks, held_out = world(0, early=4, late=1)
    assert regions(walks, held_out)
    for k, each in enumerate((-8.0, 8.0, -8.0, 8.0)):
        near = np.hypot(*(walks[k].position_m[:, :2] - SPOT).T) < 2.5
        held_out[f"s{k}"].error_uT[near, 2] += each
    assert not regions(walks, held_out)


def test_two_surveys_or_unjudged_ones_cannot_tell():
    walks, held_out = world(0, early=1, late=1)
    assert regions(walks, held_out) == ()
    walks, held_out = world(0)
    unjudged = {name: replace(h, judged=np.zeros_like(h.judged)) for name, h in held_out.items()}
    assert regions(walks, unjudged) == ()


def surveyed(building: SyntheticBuilding, changed: SyntheticBuilding, rng, early=4, late=2):
    sensor = Magnetometer(noise_uT=0.4, tilt_sd_rad=0.01, yaw_sd_rad=0.02, position_sd_m=0.1)
    return {
        f"s{k}": survey(
            building if k < early else changed,
            lawn_mower(building, 0, rng, along="xy"[k % 2], lane_m=2.0, offset_m=rng.uniform(0.0, 1.6), rate_hz=5.0),
            replace(sensor, hard_iron_uT=tuple(rng.normal(0.0, 0.3, 3))),
            rng,
        )
        for k in range(early + late)
    }


def test_metal_moved_in_the_analytic_building_is_reported_there_and_nowhere_else():
    rng = np.random.default_rng(3)
    building = make_building(rng, width_m=18.0, depth_m=15.0, floors=1)
    spot = np.array([11.0, 8.0, DEVICE_HEIGHT_M - 1.5])
    safe = Dipoles(spot[None], np.array([[20.0, -30.0, 45.0]]))
    moved = replace(building, steel=(*building.steel, safe))
    spec = MapSpec(resolution_m=0.5)
    unchanged = fit_map(surveyed(building, building, np.random.default_rng(4)), spec)
    assert unchanged.out_of_date == ()
    (region,) = fit_map(surveyed(building, moved, np.random.default_rng(4)), spec).out_of_date
    assert covers(region, spot)
    assert (region.surveys_before, region.surveys_after) == (("s0", "s1", "s2", "s3"), ("s4", "s5"))
    x0, y0, x1, y1 = region.bounds_m
    middle = np.array([[(x0 + x1) / 2, (y0 + y1) / 2, DEVICE_HEIGHT_M]])
    largest = np.abs(safe.field_uT(middle)).max()
    assert 1.0 < np.abs(region.change_ut).max() < 2.0 * largest
