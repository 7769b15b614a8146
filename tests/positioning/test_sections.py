"""Sections against the worked examples, the identities they obey, and maps of several roads."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from app.positioning.sections import (
    Anomaly,
    compared_length,
    contiguous_stretches,
    detect_anomalies,
    match_anomaly,
    peak_of,
    resample_by_distance,
    section_features,
    section_starts,
    section_transform,
    sections_at,
    sum_of_squares,
    travelled_m,
)

QUERY = np.array([[200.0, -20, 490], [205, -18, 492], [212, -15, 497], [206, -19, 493]])
MAP = QUERY + np.array([12.0, -8.0, 5.0]) + np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 2], [-1, 0, 0]])
FIELDS = st.floats(-100.0, 100.0)


def fields(samples):
    return arrays(float, (samples, 3), elements=FIELDS)


SECTIONS = st.integers(2, 9).flatmap(fields)
PAIRS = st.integers(2, 9).flatmap(lambda n: st.tuples(fields(n), fields(n)))


# ---- worked examples


@pytest.mark.parametrize(
    ("sigma", "shares", "beta"),
    [
        (2.65, [0.867275, 1.50461e-11, 1.4425e-280], 3.41187e-3),
        (7.21, [0.980947, 3.45132e-2, 1.5721e-38], 1.69404e-4),
    ],
)
def test_single_epoch_at_three_map_samples(sigma, shares, beta):
    rows = np.array([[200.0, -21, 493], [210, -30, 480], [150, 60, 500]])
    squares = sum_of_squares(np.array([[[201.0, -20, 493]]]), rows, np.arange(3))[0]
    np.testing.assert_allclose(squares, [2.0, 350.0, 9050.0])
    np.testing.assert_allclose(np.exp(-squares / (2.0 * sigma**2)), shares, rtol=1e-4)
    assert (2.0 * np.pi * sigma**2) ** -1.5 == pytest.approx(beta, rel=1e-5)


@pytest.mark.parametrize(
    ("transform", "squares"), [("raw", 975.0), ("demeaned", 5.75), ("differenced", 12.0), ("whitened", 5.75)]
)
def test_section_of_four_samples(transform, squares):
    found = sum_of_squares(QUERY[None], MAP, np.array([0]), transform)
    assert found == pytest.approx(np.array([[squares]]))
    np.testing.assert_allclose(QUERY.mean(axis=0), [205.75, -18.0, 493.0])


def test_whitened_differences_of_the_residual_in_the_text():
    residual = np.array([1.0, 0.0, -2.0, 3.0])
    for transform in ("demeaned", "whitened"):
        assert np.sum(np.square(section_transform(transform, 4) @ residual)) == pytest.approx(13.0)


# ---- identities


@given(PAIRS, arrays(float, 3, elements=FIELDS))
def test_all_but_raw_ignore_a_constant_offset(pair, offset):
    query, run = pair
    for transform in ("demeaned", "differenced", "whitened"):
        there, moved = (section_features(section[None], transform) for section in (run, run + offset))
        np.testing.assert_allclose(there, moved, atol=1e-9)
        squares = [sum_of_squares(query[None], each, np.array([0]), transform) for each in (run, run + offset)]
        np.testing.assert_allclose(*squares, rtol=1e-9, atol=1e-6)


@given(PAIRS)
def test_whitened_differences_equal_demeaning(pair):
    query, run = pair
    squares = [sum_of_squares(query[None], run, np.array([0]), transform) for transform in ("demeaned", "whitened")]
    np.testing.assert_allclose(*squares, rtol=1e-9, atol=1e-7)


@given(PAIRS)
def test_demeaning_takes_the_mean_difference_out_of_the_raw_squares(pair):
    query, run = pair
    raw, demeaned = (sum_of_squares(query[None], run, np.array([0]), t)[0, 0] for t in ("raw", "demeaned"))
    offset = np.mean(query - run, axis=0)
    assert raw == pytest.approx(demeaned + len(query) * np.sum(offset**2), rel=1e-9, abs=1e-7)


@given(PAIRS)
def test_squares_do_not_depend_on_which_side_asks(pair):
    for transform in ("raw", "demeaned", "differenced", "whitened"):
        there, back = (sum_of_squares(a[None], b, np.array([0]), transform) for a, b in (pair, pair[::-1]))
        np.testing.assert_allclose(there, back)


@pytest.mark.parametrize("transform", ["raw", "demeaned", "whitened"])
def test_white_noise_leaves_chi_square_of_the_compared_length(transform):
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(4000, 5, 3))
    squares = np.sum(np.square(section_features(noise, transform)), axis=1)
    length = compared_length(transform, 5, 3)
    assert squares.mean() == pytest.approx(length, rel=0.03)
    assert squares.var() == pytest.approx(2 * length, rel=0.1)


def test_every_run_is_compared_as_by_hand():
    rng = np.random.default_rng(1)
    field = rng.normal(size=(30, 3))
    starts = section_starts(np.repeat([0, 1], 15), 4)
    queries = sections_at(field, starts[[3, 20]], 4)
    found = sum_of_squares(queries, field, starts, "demeaned")
    for q, query in enumerate(queries):
        for s, start in enumerate(starts):
            difference = query - field[start : start + 4]
            by_hand = np.sum(np.square(difference - difference.mean(axis=0)))
            assert found[q, s] == pytest.approx(by_hand, abs=1e-9)
    assert np.argmin(found, axis=1).tolist() == [3, 20]


# ---- maps of several roads


@given(st.lists(st.integers(1, 8), min_size=1, max_size=6), st.integers(1, 6))
def test_no_section_straddles_two_stretches(lengths, samples):
    stretch = np.repeat(np.arange(len(lengths)), lengths)
    starts = section_starts(stretch, samples)
    assert len(starts) == sum(max(0, length - samples + 1) for length in lengths)
    assert all(len(set(stretch[start : start + samples])) == 1 for start in starts)


def test_stretches_end_at_gaps_at_roads_and_where_distance_starts_anew():
    along = np.array([0.0, 1.0, 2.0, 7.0, 8.0, 0.0, 1.0])
    assert contiguous_stretches(along, 1.5).tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert contiguous_stretches(along, 1.5, np.array([4, 4, 9, 9, 9, 9, 9])).tolist() == [0, 0, 1, 2, 2, 3, 3]
    assert contiguous_stretches(np.array([]), 1.5).tolist() == []


def test_resampled_by_distance_a_line_stays_a_line():
    rng = np.random.default_rng(2)
    at = np.sort(rng.uniform(0.0, 40.0, 30))  # sparser than the spacing: mostly interpolated
    found = resample_by_distance(at, np.stack([at, 3.0 - 2.0 * at], axis=1), 0.5, longest_gap_m=100.0)
    np.testing.assert_allclose(np.diff(found.distance_m), 0.5)
    np.testing.assert_allclose(found.columns[:, 1], 3.0 - 2.0 * found.columns[:, 0])
    np.testing.assert_allclose(found.columns[:, 0], found.distance_m, atol=0.25 + 1e-9)


def test_gaps_are_left_out():
    at = np.array([0.0, 1.0, 2.0, 12.0, 13.0])
    found = resample_by_distance(at, at[:, None], 1.0, longest_gap_m=3.0)
    assert found.distance_m.tolist() == [0.0, 1.0, 2.0, 12.0, 13.0]
    assert contiguous_stretches(found.distance_m, 1.5).tolist() == [0, 0, 0, 1, 1]


@given(st.lists(st.integers(0, 40), min_size=2, max_size=12))
def test_standing_still_changes_nothing(stands):
    moving_m = 0.4 * np.arange(len(stands))
    distance_m = np.repeat(moving_m, np.array(stands) + 1)
    t_s = 0.1 * np.arange(len(distance_m))
    position_m = np.stack([distance_m, 5.0 - 0.0 * distance_m], axis=1)
    walked, moving = travelled_m(t_s, position_m, 0.5)
    np.testing.assert_allclose(walked, distance_m, atol=1e-9)
    found = resample_by_distance(walked, walked[:, None], 0.5, moving=moving, longest_gap_m=2.0)
    expected = resample_by_distance(moving_m, moving_m[:, None], 0.5, longest_gap_m=2.0)
    if stands[0] == 0:  # a drive that begins by standing loses its first place
        np.testing.assert_allclose(found.columns, expected.columns, atol=1e-9)


# ---- anomalies


def bumpy(centres, rng, length=400, sd=0.05):
    """A slow field with a bump of its own shape, 2 to 4 uT, at each centre."""
    s = np.arange(float(length))
    field = np.stack([20.0 + 0.002 * s, -3.0 + np.sin(s / 200.0), -45.0 + 0.0 * s], axis=1)
    for centre in centres:
        shape = np.exp(-0.5 * ((s - centre) / rng.uniform(1.5, 3.0)) ** 2)
        direction = rng.normal(size=3)
        field += shape[:, None] * direction / np.linalg.norm(direction) * rng.uniform(2.0, 4.0)
    return field + sd * rng.normal(size=field.shape)


def test_anomalies_are_found_and_known_again():
    rng = np.random.default_rng(3)
    centres = [40, 110, 200, 290, 360]
    clean = bumpy(centres, rng, sd=0.0)
    mapped, driven = (clean + 0.05 * rng.normal(size=clean.shape) for _ in range(2))
    stretch = np.repeat([0, 1], 200)  # the third bump is cut by the joint
    found = detect_anomalies(mapped, stretch, background=61, threshold_uT=0.8, margin=3)
    assert {round(a.peak, -1) for a in found} == {40, 110, 200, 290, 360}
    assert all(stretch[a.first] == stretch[a.stop - 1] for a in found)
    assert all(a.first <= a.peak < a.stop for a in found)
    for centre in (40, 110, 290, 360):
        query = driven[centre - 12 : centre + 10] + np.array([0.3, 0.0, 0.0])
        match = match_anomaly(query, mapped, found, transform="demeaned")
        assert match is not None
        assert abs(found[match.anomaly].peak - centre) <= 2
        assert match.rms_uT < 0.5


def test_unknown_anomaly_is_above_the_threshold():
    rng = np.random.default_rng(4)
    mapped, elsewhere = bumpy([60, 150], rng), bumpy([60], np.random.default_rng(99))
    found = detect_anomalies(mapped, np.zeros(400, dtype=np.int64), background=61, threshold_uT=0.8, margin=3)
    query = elsewhere[50:72]
    assert match_anomaly(query, mapped, found) is not None
    assert match_anomaly(query, mapped, found, threshold_rms_uT=0.3) is None


def test_alignment_and_truncation_by_hand():
    field = np.zeros((12, 1))
    field[6], field[7] = 5.0, 1.0
    query = np.array([[0.0], [0.0], [0.0], [6.0], [3.0]])
    match = match_anomaly(query, field, [Anomaly(5, 9, 6)])  # one sample before the peak, one after: 0 6 3 on 0 5 1
    assert match is not None
    assert match.samples == 3
    assert match.rss_uT == pytest.approx(np.sqrt(0.0 + 1.0 + 4.0))
    assert match.rms_uT == pytest.approx(np.sqrt(5.0 / 3.0))


def test_root_sums_favour_what_shares_little():
    query = np.array([[0.0], [0.0], [5.0], [0.0], [0.0]])
    field = np.array([[5.7], [0.7], [-0.5], [0.5], [4.5], [0.5], [-0.5]])
    short, long = Anomaly(0, 2, 0), Anomaly(2, 7, 4)  # 0.7 off in two samples, 0.5 off in five
    by_rss, by_rms = (match_anomaly(query, field, [short, long], by=by) for by in ("rss", "rms"))
    assert by_rss is not None
    assert by_rms is not None
    assert (by_rss.anomaly, by_rms.anomaly) == (0, 1)
    assert by_rss.rss_uT == pytest.approx(0.7 * np.sqrt(2.0))
    assert by_rms.rms_uT == pytest.approx(0.5)


@given(SECTIONS)
def test_peak_is_the_farthest_from_the_median(section):
    away = np.linalg.norm(section - np.median(section, axis=0), axis=1)
    assert away[peak_of(section)] == away.max()


def test_nothing_to_compare_is_no_match():
    assert match_anomaly(QUERY, MAP, []) is None
    assert match_anomaly(QUERY, MAP, [Anomaly(2, 3, 2)], transform="demeaned") is None
