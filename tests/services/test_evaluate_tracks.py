"""Filters along walks: hand-made rows whose scores are known, exact maps, and a small building from end to end."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2
from typer.testing import CliRunner

from app.cli import main
from app.errors import InvalidInput
from app.field.grid import FieldGrid
from app.field.samples import Samples
from app.services.compared_filters import make_filters
from app.services.evaluate_tracks import TrackPlan, evaluate_tracks, judged
from app.services.followed_walks import NOWHERE, Rows, Start, WalkToFollow, covered, real_walk, rows_of, steps_of
from app.services.told_filters import _reckoned_covariance_m2
from app.services.track_scores import judge_track
from app.services.track_summary import nees_band, summarise_tracks
from app.survey.walk import DeadReckoning, Walk
from app.synthetic.building import DEVICE_HEIGHT_M, make_building
from app.synthetic.sensors import Magnetometer
from app.synthetic.steps import DeadReckoned
from app.synthetic.storeys import carry_between_storeys, walk_between_storeys
from app.synthetic.tracked_walks import SyntheticPlan, walks_to_follow
from app.tracking.options import TrackOptions

REAL = Path(os.environ.get("ISODYN_TEST_DATA", "../shared/data")) / "indoor-location-20" / "site2"


def straight(n=41, spacing_m=0.5, floors=None, name="a", is_covered=True):
    """A walk along x, a step every half metre and second."""
    at = spacing_m * np.arange(n)
    truth = np.column_stack([at, np.zeros(n)])
    floor = np.zeros(n, dtype=np.int64) if floors is None else np.asarray(floors)
    return WalkToFollow("F", name, is_covered, (), truth, floor, at, Start(0, (0.0, 0.0), 0.0))


def said(walk, off_m, state, floor=None, sd_m=1.0):
    """Rows that are `off_m` (n,) to the left of the truth."""
    n = len(walk.truth_m)
    position = walk.truth_m + np.column_stack([np.zeros(n), off_m])
    covariance = np.tile(sd_m**2 * np.eye(2), (n, 1, 1))
    floor = walk.truth_floor if floor is None else np.asarray(floor)
    return Rows(0.5 * np.arange(n), floor, position, covariance, tuple(state))


def test_scores_of_hand_made_rows():
    walk = straight()
    off = np.r_[np.full(20, np.nan), np.full(10, 2.0), np.full(11, 6.0)]
    state = ["searching"] * 20 + ["converged"] * 15 + ["lost"] * 6
    floor = np.r_[np.full(20, NOWHERE), np.zeros(20), [0]].astype(int)
    track = judge_track("x", "nothing", walk, said(walk, off, state, floor, sd_m=2.0), 1.5)
    assert len(track.error_m) == len(track.state) == len(track.nees) == 21
    assert track.error_m[9:11] == (np.inf, 2.0)
    assert track.error_m[20] == track.end_error_m == 6.0
    assert np.isnan(track.nees[9])
    assert track.nees[10] == pytest.approx(1.0)
    assert track.nees[15] == pytest.approx(9.0)
    assert (track.converged_m, track.converged_s) == (10.0, 10.0)
    assert track.end_state == "lost"
    assert (track.length_m, track.duration_s) == (20.0, 20.0)


def test_a_covariance_of_nothing_is_infinitely_sure():
    walk = straight()
    rows = said(walk, np.full(41, 1.0), ["converged"] * 41)
    rows.covariance_m2[10] = [[1e-40, 0.0], [0.0, 1.0]]
    track = judge_track("x", "nothing", walk, rows, 1.0)
    assert track.nees[5] == np.inf
    (summary,) = summarise_tracks([track], (5.0,))
    assert (summary.nees.infinite, summary.nees.mean.value) == (1, pytest.approx(1.0))
    assert summary.nees.consistent


def test_a_wrong_floor_is_infinitely_wrong_and_changes_are_counted():
    n = 81
    walk = straight(n, floors=np.where(np.arange(n) < 30, 0, 1))
    late = np.where(np.arange(n) < 40, 0, 1)
    track = judge_track("x", "nothing", walk, said(walk, np.zeros(n), ["converged"] * n, late), 1.0)
    assert track.error_m[14] == track.error_m[20] == 0.0
    assert track.error_m[16] == np.inf
    assert np.isnan(track.nees[16])
    assert (track.floor_changes, track.floor_changes_found, track.floor_changes_made) == (1, 1, 1)
    never = judge_track("x", "nothing", walk, said(walk, np.zeros(n), ["converged"] * n, np.zeros(n, int)), 1.0)
    assert (never.floor_changes_found, never.floor_changes_made, never.end_error_m) == (0, 0, np.inf)


def test_summaries_of_hand_made_tracks():
    tracks = []
    for k, (off_m, is_covered) in enumerate([(0.5, True), (1.5, True), (7.0, True), (30.0, False)]):
        walk = straight(name=str(k), is_covered=is_covered)
        state = ["searching"] * 10 + ["converged"] * 31 if k < 3 else ["searching"] * 41
        tracks.append(judge_track("x", "nothing", walk, said(walk, np.full(41, off_m), state), 2.0))
    everything, ground = summarise_tracks(tracks, (1.0, 5.0))
    assert (everything.walks, ground.walks, ground.covered_only) == (4, 3, True)
    assert [each.share for each in everything.ends_within.values()] == [0.25, 0.5, 0.5]
    assert ground.ends_within["5"].share == pytest.approx(2 / 3)
    assert ground.end_median_m.value == 1.5
    assert everything.converged.share == everything.claims_ends.share == 0.75
    assert everything.converged_m == (5.0, 5.0)
    assert everything.false_ends["5"].share == everything.false_metres["5"].share == pytest.approx(1 / 3)
    assert everything.false_ends["1"].share == pytest.approx(2 / 3)
    assert everything.claims_metres.share == pytest.approx(3 * 16 / (4 * 21))
    assert everything.along_m["p95"] == 7.0
    assert everything.lost.share == 0.0
    assert everything.at_30_m.share is None  # none of them is that long
    assert everything.nees.mean.value == pytest.approx(np.mean([0.25, 2.25, 49.0]))
    assert everything.nees.band == nees_band(3)
    assert not everything.nees.consistent


def test_told_filters_are_judged_from_the_start():
    walk = straight()
    rows = said(walk, 0.1 * np.arange(41), ["searching"] * 41)
    told, alone = (
        summarise_tracks([judge_track("x", told, walk, rows, 1.0)], (5.0,))[0] for told in ("start, heading", "nothing")
    )
    assert told.along_m["p50"] == pytest.approx(2.0)
    assert np.isnan(alone.along_m["p50"])
    assert alone.converged_m is None
    assert alone.false_ends["5"].share is None


def test_the_band_of_nees_holds_means_of_chi_squares():
    low, high = nees_band(25)
    means = np.random.default_rng(0).chisquare(2, size=(20_000, 25)).mean(axis=1)
    assert np.mean((means >= low) & (means <= high)) == pytest.approx(0.95, abs=0.01)
    assert nees_band(1) == pytest.approx(tuple(chi2.ppf([0.025, 0.975], 2)))
    assert low < 2.0 < high


def test_a_walk_is_covered_where_most_of_it_is_near_the_map():
    mapped = np.column_stack([np.arange(0.0, 16.5, 0.5), np.zeros(33)])
    walk = np.column_stack([np.linspace(0.0, 20.0, 201), np.full(201, 1.2)])
    assert covered(walk, mapped)
    assert not covered(walk + np.array([5.0, 0.0]), mapped)
    assert not covered(walk + np.array([0.0, 0.5]), mapped)


def circling(heading_0=0.4, n=400):
    """A circle of 10 m radius seen from its first level frame, under a field that points north."""
    yaw = np.arange(n) * 0.01
    place = 10.0 * np.stack([np.sin(yaw), 1.0 - np.cos(yaw), 0 * yaw], axis=1)
    north = np.stack([np.sin(yaw + heading_0), np.cos(yaw + heading_0), 0 * yaw - 2.0], axis=1) * 20.0
    c, s = np.cos(heading_0), np.sin(heading_0)
    p = place @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    q = np.column_stack([np.cos(0.5 * (yaw + heading_0)), 0 * yaw, 0 * yaw, np.sin(0.5 * (yaw + heading_0))])
    level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    empty = np.empty(0)
    reckoned = DeadReckoning(place, yaw, north, level, empty, empty, heading_0 + yaw, np.full(n, 0.1), 4.0)
    return Walk(Samples(0.1 * np.arange(n), p, north, "building", q), {}, reckoned)


def test_steps_are_in_the_level_frame_of_the_first_sample():
    walk = circling()
    steps = steps_of(walk)
    c, s = np.cos(0.4), np.sin(0.4)
    B = np.array([step.B_uT for step in steps]) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    np.testing.assert_allclose(B, np.tile([0.0, 20.0, -40.0], (len(steps), 1)), atol=1e-9)
    assert steps[200].heading_rad == pytest.approx(0.4)
    assert steps[200].heading_sd_rad == 0.1
    assert steps[200].yaw_rad == pytest.approx(2.0)
    blind = steps_of(replace(walk, dead_reckoning=replace(walk.dead_reckoning, heading_rad=None, heading_sd_rad=None)))
    assert blind[200].heading_rad is None


def test_the_told_start_is_the_truth_and_reckoning_from_it_comes_home():
    asked = real_walk("F", 0, "w", circling(), np.zeros((1, 2)))
    assert asked.start.heading_rad == pytest.approx(0.4)
    assert not asked.covered
    assert asked.walked_m[-1] == pytest.approx(39.9, abs=0.1)
    building = make_building(np.random.default_rng(0), width_m=10.0, depth_m=10.0, floors=1)
    reckoning = make_filters({"F": exact_map(building, 0)}, TrackOptions(), 100, 0)[-1]
    assert reckoning.name == "dead reckoning"
    assert max(judged(reckoning, asked).error_m) < 1e-9


def test_the_covariance_of_reckoning_is_that_of_drawn_reckonings():
    rng = np.random.default_rng(0)
    course = np.cumsum(0.1 * rng.normal(size=60))
    way = 0.5 * np.column_stack([np.cos(course), np.sin(course)])
    options = TrackOptions(step_scale_sd=0.05, course_sd_rad=0.03, heading_drift_sd_rad_per_m=0.004,
                           heading_walk_rad=0.02, position_walk_m=0.1)  # fmt: skip
    n, path = 20_000, 0.5 * np.arange(1, 61)
    turn = options.course_sd_rad * rng.normal(size=(n, 1))
    turn = turn + options.heading_drift_sd_rad_per_m * rng.normal(size=(n, 1)) * path
    turn = turn + np.cumsum(options.heading_walk_rad * np.sqrt(0.5) * rng.normal(size=(n, 60)), axis=1)
    scale = 1.0 + options.step_scale_sd * rng.normal(size=(n, 1))
    x = np.sum(scale * (np.cos(turn) * way[:, 0] - np.sin(turn) * way[:, 1]), axis=1)
    y = np.sum(scale * (np.sin(turn) * way[:, 0] + np.cos(turn) * way[:, 1]), axis=1)
    drawn = np.cov(x, y) + (options.position_walk_m**2 * path[-1] + 0.01) * np.eye(2)
    place = np.vstack([[0.0, 0.0], np.cumsum(way, axis=0)])
    found = _reckoned_covariance_m2(place, options)[-1]
    np.testing.assert_allclose(found, drawn, atol=0.06 * np.trace(drawn))


def exact_map(building, floor, resolution_m=0.5, sd_uT=0.3):
    """The building's own field as a map."""
    points = building.device_grid_m(floor, resolution_m)
    ny, nx, _ = points.shape
    mean = building.field_uT(points).reshape(1, ny, nx, 3).astype(np.float32)
    return FieldGrid(
        components="vector", origin_m=(float(points[0, 0, 0]), float(points[0, 0, 1])), resolution_m=resolution_m,
        heights_m=np.array([building.elevations_m[floor] + DEVICE_HEIGHT_M]), mean_uT=mean,
        sd_uT=np.full_like(mean, sd_uT), gradient_uT_per_m=np.zeros((1, ny, nx, 3, 2), dtype=np.float32),
        measured=np.ones((1, ny, nx), dtype=np.bool_), ambient_uT=mean.mean(axis=(0, 1, 2)).astype(np.float64),
        prior_sd_uT=np.full(3, 6.0), noise_sd_uT=np.full(3, 0.4), error_correlation_m=2.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def storeys():
    """A small building of two floors, its exact maps, and three walks: the second changes floors by stairs."""
    rng = np.random.default_rng(2)
    building = make_building(rng, width_m=20.0, depth_m=15.0, floors=2)
    grids = {str(k): exact_map(building, k) for k in range(2)}
    mapped = [building.device_grid_m(k).reshape(-1, 3)[:, :2] for k in range(2)]
    plan = SyntheticPlan(walks=3, length_m=45.0, floors=2)
    return building, grids, walks_to_follow(building, plan, mapped, rng)


def test_filters_on_exact_maps_know_where_they_are(storeys):
    _, grids, walks = storeys
    filters = {each.name: each for each in make_filters(grids, TrackOptions(), 4000, 0)}
    assert list(filters) == ["adaptive", "particle filter", "Kalman, ML fixes", "MAD + contour", "dead reckoning"]
    found = {name: [judged(each, walk) for walk in walks] for name, each in filters.items()}
    assert all(walk.covered for walk in walks)
    for track in found["adaptive"]:
        assert track.converged_m is not None, track
        assert track.end_error_m < 1.5, track
    assert [track.floor_changes for track in found["adaptive"]] == [0, 1, 0]
    assert [track.floor_changes_found for track in found["adaptive"]] == [0, 1, 0]
    for name in ("Kalman, ML fixes", "MAD + contour", "dead reckoning"):
        assert all(track.error_m[0] < 0.7 and track.told == "start, heading" for track in found[name]), name
        assert np.median([track.end_error_m for track in found[name]]) < 8.0, name
    assert all(track.told == "nothing" for track in found["particle filter"])
    # The same steps give the same rows.
    again = judged(filters["particle filter"], walks[0])
    assert replace(again, cpu_ms=0.0).error_m == found["particle filter"][0].error_m


def test_many_particles_about_a_small_floor_find_themselves(storeys):
    _, grids, walks = storeys
    particles = make_filters({"0": grids["0"]}, TrackOptions(), 20_000, 0)[1]
    track = judged(particles, walks[0])
    assert track.end_error_m < 2.0
    assert track.converged_m is not None


def test_a_lift_takes_time_and_stairs_take_way():
    rng = np.random.default_rng(3)
    building = make_building(rng, width_m=20.0, depth_m=15.0, floors=3)
    for way in ("stairs", "lift"):
        walk = walk_between_storeys(building, 2, 1, way, rng, length_m=40.0)
        carried = carry_between_storeys(building, walk, Magnetometer(), DeadReckoned(), rng)
        assert set(walk.floor) == {1, 2}
        assert walk.risen_m[-1] == pytest.approx(-building.storey_m)
        assert carried.steps[-1].displacement_m[2] == pytest.approx(-building.storey_m, rel=0.12)
        assert carried.truth_m[-1, 2] == pytest.approx(building.elevations_m[1] + DEVICE_HEIGHT_M, abs=0.1)
        climbing = (walk.risen_m < 0) & (walk.risen_m > -building.storey_m)
        on_the_way_m = np.ptp(walk.walk.path_length_m()[climbing])
        assert on_the_way_m == pytest.approx(6.0 if way == "stairs" else 0.0, abs=0.5)
        assert np.all(np.diff(walk.walk.t_s) > 0.0)


def test_rows_are_put_together_step_by_step():
    steps = steps_of(circling(n=3))
    rows = rows_of(steps, [0, 0, 1], [np.zeros(2)] * 3, [np.eye(2)] * 3, ["searching"] * 3)
    assert rows.position_m.shape == (3, 2)
    assert rows.covariance_m2.shape == (3, 2, 2)
    assert rows.t_s[2] == pytest.approx(0.2)


@pytest.mark.slow
def test_a_known_building_is_followed_end_to_end(building, tmp_path):
    report, picture = tmp_path / "tracks.json", tmp_path / "tracks.png"
    result = CliRunner().invoke(
        main, ["evaluate", "tracks", str(building), "--all-floors", "--particles", "2000", "--processes", "1",
               "--json", str(report), "--plot", str(picture)],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    for words in ("adaptive", "MAD + contour", "start, heading", "Convergence", "NEES", "broken.txt"):
        assert words in result.output
    tracks = json.loads(report.read_text())["evaluation"]["tracks"]
    assert {(t["floor_id"], t["walk"]) for t in tracks} == {("F0", "walk-4"), ("F1", "walk-4")}
    assert len({t["filter"] for t in tracks}) == 5
    assert all(t["covered"] for t in tracks)
    reckoned = [t for t in tracks if t["filter"] == "dead reckoning"]
    assert all(t["error_m"][0] == 0.0 and t["end_error_m"] < 5.0 for t in reckoned)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_folder_without_floors_is_refused(tmp_path):
    with pytest.raises(InvalidInput, match="no floor to evaluate"):
        evaluate_tracks(tmp_path, TrackPlan(), lambda *_: None)


@pytest.mark.slow
@pytest.mark.real_data
@pytest.mark.timeout(1500)
@pytest.mark.skipif(not REAL.is_dir(), reason=f"real walks are not at {REAL}: set ISODYN_TEST_DATA")
def test_real_walks_are_followed_better_by_the_map_than_by_chance(tmp_path):
    (tmp_path / "F1").symlink_to((REAL / "F1").resolve())
    tracks = evaluate_tracks(tmp_path, TrackPlan(particles=5000), lambda *_: None).tracks
    ends = {
        name: [t.end_error_m for t in tracks if t.filter == name and t.covered]
        for name in ("adaptive", "dead reckoning")
    }
    assert len(ends["adaptive"]) >= 5
    assert np.mean(np.array(ends["adaptive"]) <= 5.0) > 0.3  # by chance: .01
    assert np.mean(np.array(ends["dead reckoning"]) <= 5.0) > 0.5
