"""Disturbed stretches of scripted walks: what was put in is found and named, and undisturbed walks are left alone."""

import gzip
import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from app.attitude.departures import Expected, departures, expected_from_map, expected_from_other_visits
from app.attitude.stretches import disturbed_samples, find_disturbed_stretches
from app.attitude.sudden_changes import find_hum, find_steps, find_stuck, white_noise_sd_uT
from app.errors import InvalidInput
from app.field.error_structure import ErrorStructure
from app.survey.indoor_location import read_indoor_location
from app.synthetic import Magnetometer, ornstein_uhlenbeck, random_waypoints, survey
from app.synthetic.building import make_building

REAL = Path(os.environ.get("ISODYN_TEST_DATA", "../shared/data")) / "indoor-location-20" / "site2"
RATE_HZ = 10.0
WHITE = ErrorStructure(0.1, 0.6, 0.3, 2.0)


def smooth_uT(p):
    """A field that changes by some uT over a metre."""
    x, y = p[:, 0], p[:, 1]
    return np.stack(
        [18 + 6 * np.sin(0.9 * x) * np.cos(0.7 * y), 3 + 5 * np.cos(0.6 * x - 0.8 * y), -42 + 6 * np.sin(0.5 * x + y)],
        axis=1,
    )


def loop_walk(seed, laps=1.6, rest=None):
    """A walk around a square of 12 m at 1.2 m/s, with a rest of 20 s from a sample on: times, places, readings."""
    rng = np.random.default_rng(seed)
    along = np.arange(0.0, laps * 48.0, 1.2 / RATE_HZ)
    if rest is not None:
        along = np.concatenate([along[:rest], np.full(200, along[rest]), along[rest:]])
    corners = np.array([[0, 0], [12, 0], [12, 12], [0, 12], [0, 0]], dtype=float)
    at = np.mod(along, 48.0)
    p = np.stack([np.interp(at, np.arange(5) * 12.0, corners[:, k]) for k in (0, 1)], axis=1)
    t = np.arange(len(p)) / RATE_HZ
    return t, np.column_stack([p, np.full(len(p), 1.2)]), smooth_uT(p) + 0.4 * rng.normal(size=(len(p), 3))


def kinds(stretches):
    return [each.kind for each in stretches]


def test_a_clean_walk_has_none():
    for seed in range(10):
        t, p, B = loop_walk(seed, rest=250)
        assert find_disturbed_stretches(t, B, p) == ()
        assert find_disturbed_stretches(t, np.linalg.norm(B, axis=1), p) == ()


def test_a_motor_is_a_step_and_back():
    t, p, B = loop_walk(1, laps=0.9)
    on = (t >= 12.0) & (t < 22.0)
    B[on] += [6.0, -6.0, 5.0]
    (found,) = find_disturbed_stretches(t, B, p)
    assert found.kind == "step and back"
    assert found.start_s == pytest.approx(12.0, abs=0.35)
    assert found.end_s == pytest.approx(22.0, abs=0.35)
    assert found.size_uT == pytest.approx(np.sqrt(97.0), rel=0.25)
    assert "and back" in found.reason
    assert found.p_value < 1e-3
    marked = disturbed_samples(t, (found,))
    assert marked[on].all()
    assert marked.sum() < on.sum() + 10


def test_an_attached_magnet_is_a_step_that_stays():
    t, p, B = loop_walk(2, laps=0.9)
    B[t >= 15.0] += [15.0, 10.0, -20.0]
    (found,) = find_disturbed_stretches(t, B, p)
    assert found.kind == "step that stays"
    assert found.start_s == pytest.approx(15.0, abs=0.35)
    assert found.end_s == t[-1]


def test_norms_tell_of_a_step_too():
    t, p, B = loop_walk(2, laps=0.9)
    B[t >= 15.0] += [5.0, 0.0, -20.0]
    (found,) = find_disturbed_stretches(t, np.linalg.norm(B, axis=1), p)
    # One component tells less: the step is clear, that it stays may not be.
    assert found.kind in ("step", "step that stays")
    assert found.start_s == pytest.approx(15.0, abs=0.7)


def test_hum_is_found_where_it_is():
    t, p, B = loop_walk(3, laps=0.9)
    on = (t >= 10.0) & (t < 14.0)
    B[on] += 2.5 * np.cos(np.pi * 0.9 * np.arange(on.sum()))[:, None]
    (found,) = find_disturbed_stretches(t, B, p)
    assert found.kind == "hum"
    assert found.start_s == pytest.approx(10.0, abs=1.5)
    assert found.end_s == pytest.approx(14.0, abs=1.5)


def test_a_sensor_that_repeats_itself_is_stuck_and_what_follows_is_no_step():
    t, p, B = loop_walk(4, laps=0.9)
    B[200:212] = B[200]
    found = find_disturbed_stretches(t, B, p)
    assert kinds(found) == ["stuck"]
    assert found[0].start_s == pytest.approx(20.0, abs=0.2)
    assert found[0].end_s == pytest.approx(21.1, abs=0.2)


def test_a_sensor_of_coarse_steps_is_not_stuck():
    """A phone's steps are 0.15 uT, an old one's a whole microtesla: it repeats readings because it cannot do other."""
    t, p, B = loop_walk(3)
    for step_uT in (0.15, 1.0):
        assert kinds(find_disturbed_stretches(t, np.round(B / step_uT) * step_uT, p)) == []


def test_a_trolley_that_passes_while_the_device_stands_still():
    t, p, B = loop_walk(5, laps=0.9, rest=150)
    B += 20.0 * np.exp(-0.5 * ((t - 25.0) / 1.5) ** 2)[:, None] * [0.6, -0.6, 0.5]
    found = find_disturbed_stretches(t, B, p)
    assert kinds(found) == ["standstill"]
    assert 22.0 < found[0].start_s < 25.0 < found[0].end_s < 28.0


def test_a_trolley_that_passes_a_walker_shows_against_a_map_and_against_another_visit():
    t, p, B = loop_walk(6, laps=2.0)
    passing = 30.0 * np.exp(-0.5 * ((t - 50.0) / 1.0) ** 2)[:, None] * [0.6, -0.6, 0.5]
    mean = smooth_uT(p)
    expected = Expected(mean, np.full_like(mean, 1.0), WHITE)
    (found,) = find_disturbed_stretches(t[:390], (B + passing)[:390], p[:390], expected=None) or (None,)
    assert found is None  # as smooth as steel, and nobody was there before
    t_1, p_1, B_1 = (x[240:640] for x in (t, p, B + passing))
    single = find_disturbed_stretches(t_1, B_1, p_1, expected=Expected(mean[240:640], expected.sd_uT[240:640], WHITE))
    assert "map" in kinds(single)
    assert any(each.start_s < 50.0 < each.end_s for each in single)
    again = find_disturbed_stretches(t, B + passing, p)
    assert "revisit" in kinds(again)
    assert any(each.start_s < 50.0 < each.end_s for each in again)


def test_a_bias_of_the_whole_walk_departs_nowhere():
    t, p, B = loop_walk(7)
    mean = smooth_uT(p) + 12.0
    assert find_disturbed_stretches(t, B, p, expected=Expected(mean, np.full_like(mean, 1.0), WHITE)) == ()


def test_errors_that_hang_together_as_stated_depart_rarely():
    """Walks whose errors are drawn from the very structure: at most a few per cent have any departure."""
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 120.0, 0.1)
    path = 1.2 * t
    called = 0
    for _ in range(200):
        walk = ornstein_uhlenbeck(rng, path, np.sqrt(0.6), 2.0, 3)
        errors = walk + np.sqrt(0.3) * rng.normal(size=(len(t), 3)) + np.sqrt(0.1) * rng.normal(size=3)
        called += bool(departures(t, path, errors, Expected(np.zeros((len(t), 3)), np.ones((len(t), 3)), WHITE)))
    assert called <= 8


def test_what_is_not_expected_is_not_judged():
    t, p, B = loop_walk(9)
    nothing = Expected(np.full_like(B, np.nan), np.full_like(B, np.nan))
    assert departures(t, 1.2 * t, B, nothing) == []
    visits = expected_from_other_visits(t, p, B, 0.4, 5.0, 0.0)
    once = t < 48.0 * 0.6 / 1.2
    assert np.isfinite(visits.mean_uT[once]).all(axis=1).mean() > 0.9
    middle = (t > 48.0 * 0.65 / 1.2) & (t < 48.0 * 0.95 / 1.2)
    assert not np.isfinite(visits.mean_uT[middle]).any()


def test_a_map_states_what_to_expect(hall_grid):
    p = np.array([[5.0, 4.0, 1.2], [6.0, 3.0, 1.2], [400.0, 3.0, 1.2]])
    expected = expected_from_map(hall_grid, p, more_sd_uT=0.3)
    assert np.isnan(expected.mean_uT[2]).all()
    np.testing.assert_allclose(expected.mean_uT[:2], hall_grid.at(p).mean_uT[:2])
    np.testing.assert_allclose(expected.sd_uT[:2], np.sqrt(0.3**2 + 0.4**2 + 0.3**2), rtol=1e-3)


def test_white_noise_is_told_from_the_field():
    t, _, B = loop_walk(10, laps=3.0)
    assert white_noise_sd_uT(B) == pytest.approx(0.4, rel=0.1)
    assert find_steps(t, B, 0.4) == []
    assert find_hum(t, B, 0.4, []) == []
    assert find_stuck(B, 0.4) == []


def test_stretches_that_overlap_are_one():
    t, p, B = loop_walk(11, laps=0.9)
    on = (t >= 12.0) & (t < 22.0)
    B[on] += [6.0, -6.0, 5.0]
    humming = (t >= 20.0) & (t < 25.0)
    B[humming] += 3.0 * np.cos(np.pi * 0.9 * np.arange(humming.sum()))[:, None]
    found = find_disturbed_stretches(t, B, p)
    assert all(a.end_s < b.start_s for a, b in pairwise(found))
    assert disturbed_samples(t, found)[(t > 12.5) & (t < 24.0)].mean() > 0.5


def test_undisturbed_walks_of_a_building_are_called_disturbed_for_less_than_one_per_cent_of_their_time():
    marked = walked = 0.0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        building = make_building(rng, floors=1, width_m=24.0, depth_m=18.0)
        for _ in range(4):
            hard_iron = tuple(rng.normal(0.0, 0.5, 3))
            sensor = Magnetometer(0.4, hard_iron, tilt_sd_rad=0.01, yaw_sd_rad=0.03, position_sd_m=0.1)
            samples = survey(building, random_waypoints(building, 0, rng, length_m=200.0), sensor, rng)
            found = find_disturbed_stretches(samples.t_s, samples.B_uT, samples.p_building_m)
            marked += sum(each.end_s - each.start_s for each in found)
            walked += float(np.ptp(samples.t_s))
    assert marked < 0.01 * walked


@pytest.mark.real_data
@pytest.mark.skipif(not REAL.is_dir(), reason=f"real walks are not at {REAL}: set ISODYN_TEST_DATA")
def test_real_walks_are_called_disturbed_for_less_than_two_per_cent_of_their_time():
    marked = walked = 0.0
    for file in sorted(REAL.glob("*/*.txt.gz"))[::9]:
        samples = read_indoor_location(gzip.decompress(file.read_bytes())).samples
        found = find_disturbed_stretches(samples.t_s, samples.B_uT, samples.p_building_m)
        marked += sum(each.end_s - each.start_s for each in found if each.kind != "stuck")
        walked += float(np.ptp(samples.t_s))
    assert marked < 0.02 * walked


def test_short_walks_are_not_judged_and_bad_ones_refused():
    t, p, B = loop_walk(12)
    assert find_disturbed_stretches(t[:10], B[:10], p[:10]) == ()
    with pytest.raises(InvalidInput, match="positions"):
        find_disturbed_stretches(t, B, p[:-1])
    with pytest.raises(InvalidInput, match="one time"):
        find_disturbed_stretches(np.repeat(t[::2], 2)[: len(t)], B, p)
    with pytest.raises(InvalidInput, match="not a number"):
        find_disturbed_stretches(t, np.where(np.arange(len(t))[:, None] == 5, np.nan, B), p)


@pytest.mark.parametrize("times", ["years of silence", "next to no time"])
def test_any_times_are_judged_in_little_memory(times):
    """The clock of a device may be set while it records; windows of silence would fill terabytes."""
    t, p, B = loop_walk(1)
    t = np.where(np.arange(len(t)) > 100, t + 1e12, t) if times == "years of silence" else 1e-300 * (1 + t)
    assert "hum" not in kinds(find_disturbed_stretches(t, B, p))
