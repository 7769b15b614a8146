"""The reader of phone traces against walks that are known exactly, and against damaged ones."""

import contextlib
import gzip
import os
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.errors import UnreadableSurvey
from app.geometry import rotate_by_quaternion
from app.survey.read import read_survey

REAL = Path(os.environ.get("ISODYN_TEST_DATA", "../shared/data")) / "indoor-location-20" / "site2"


def read(data):
    return read_survey(data, format="indoor-location-2020")


def refused(data):
    with pytest.raises(UnreadableSurvey) as caught:
        read(data)
    assert caught.value.faults
    return caught.value


def truth(known, walk, columns):
    return np.stack([np.interp(walk.samples.t_s, known.t_s, column) for column in columns.T], axis=1)


def yaw_of(samples):
    """Yaw of the phone's top edge, from its attitude."""
    forward = Rotation.from_quat(samples.q_body_to_building, scalar_first=True).apply([0.0, 1.0, 0.0])
    return np.arctan2(forward[:, 1], forward[:, 0])


def without(text, *kinds):
    return re.sub(rf"^\d+\tTYPE_({'|'.join(kinds)})\t.*\n", "", text, flags=re.MULTILINE)


def test_positions_are_right_to_decimetres_though_the_walk_is_uneven(known_walk):
    walk = read(known_walk.data)
    error_m = np.linalg.norm(walk.samples.p_building_m[:, :2] - truth(known_walk, walk, known_walk.p_m), axis=1)
    assert np.median(error_m) < 0.25
    assert error_m.max() < 0.7
    # Spreading seconds instead of steps is metres wrong, since the walker waits at corners.
    tapped_s = [known_walk.t_s[np.argmin(np.linalg.norm(known_walk.p_m - c, axis=1))] for c in known_walk.corners_m]
    even = np.stack([np.interp(walk.samples.t_s, tapped_s, c) for c in known_walk.corners_m.T], axis=1)
    assert np.linalg.norm(even - truth(known_walk, walk, known_walk.p_m), axis=1).max() > 1.5


@pytest.mark.parametrize("seed", range(3))
def test_field_and_attitude_are_right(walk_maker, field, seed):
    turn = 2.0 * np.pi * seed / 3.0
    c, s = np.cos(turn), np.sin(turn)
    corners = np.array([[0, 0], [18, 0], [18, 9], [4, 12], [4, 2]]) @ np.array([[c, s], [-s, c]]) + [40.0, 60.0]
    known = walk_maker(seed=seed, corners=tuple(map(tuple, corners)))
    walk = read(known.data)
    off = yaw_of(walk.samples) - truth(known, walk, known.yaw_rad[:, None])[:, 0]
    off_deg = np.degrees((off + np.pi) % (2 * np.pi) - np.pi)
    assert np.abs(off_deg).max() < 3.0
    p = truth(known, walk, known.p_m)
    error_uT = walk.samples.B_uT - field(p)
    assert np.all(np.sqrt(np.mean(np.square(error_uT), axis=0)) < [1.6, 0.5, 0.3])
    assert walk.samples.session == "-20.0000,9.5000,-317.2500"
    assert np.all(walk.samples.p_building_m[:, 2] == 1.2)


def test_attitude_rotates_the_body_field_to_the_samples(known_walk):
    walk = read(known_walk.data)
    raw = np.array(
        [line.split("\t")[2:5] for line in known_walk.text.splitlines() if "TYPE_MAGNETIC_FIELD\t" in line], dtype=float
    )
    middle = raw[2::4][: len(walk.samples)]
    again = rotate_by_quaternion(walk.samples.q_body_to_building[: len(middle)], middle)
    assert np.sqrt(np.mean(np.square(again - walk.samples.B_uT[: len(middle)]))) < 0.6


def test_dead_reckoning_knows_no_labels(known_walk):
    walk = read(known_walk.data)
    shifted = re.sub(
        r"TYPE_WAYPOINT\t(\S+)\t(\S+)",
        lambda m: f"TYPE_WAYPOINT\t{-float(m[2]) + 30}\t{float(m[1]) + 7}",
        known_walk.text,
    )
    other = read(shifted.encode())
    for name in ("displacement_m", "yaw_rad", "B_level_uT", "heading_rad", "heading_sd_rad", "step_length_m"):
        np.testing.assert_array_equal(getattr(walk.dead_reckoning, name), getattr(other.dead_reckoning, name))


def test_dead_reckoning_follows_the_walk_in_the_first_level_frame(known_walk):
    walk = read(known_walk.data)
    reckoned = walk.dead_reckoning
    p = truth(known_walk, walk, known_walk.p_m)
    error_m = np.linalg.norm(reckoned.displacement_m[:, :2] - (p - p[0]), axis=1)  # the walk starts along +x
    assert error_m.max() < 1.5
    assert reckoned.displacement_m.shape == reckoned.B_level_uT.shape == walk.samples.B_uT.shape
    turned = truth(known_walk, walk, known_walk.yaw_rad[:, None])[:, 0] - known_walk.yaw_rad[0]
    np.testing.assert_allclose(reckoned.yaw_rad, turned, atol=0.06)
    off = reckoned.heading_rad - turned - known_walk.yaw_rad[0]
    assert np.all(np.abs(off) < 2 * reckoned.heading_sd_rad)
    assert len(reckoned.step_t_s) == len(reckoned.step_length_m) == walk.report["quality"]["steps"]


def test_dead_reckoning_and_samples_hold_the_same_field(known_walk):
    walk = read(known_walk.data)
    reckoned, B = walk.dead_reckoning, walk.samples.B_uT
    np.testing.assert_allclose(reckoned.B_level_uT[:, 2], B[:, 2], atol=1e-9)
    horizontal = np.hypot(*reckoned.B_level_uT[:, :2].T)
    np.testing.assert_allclose(horizontal, np.hypot(B[:, 0], B[:, 1]), atol=0.3)


def test_report_says_what_was_assumed_and_how_good_the_walk_is(known_walk):
    report = read(known_walk.data).report
    quality = report["quality"]
    assert 50 <= quality["steps"] <= 62
    assert quality["waypoints"] == 4
    assert quality["bias_ut"] == [-20.0, 9.5, -317.25]
    assert quality["bias_changes"] == 0
    assert abs(quality["leg_scale_median"] - 1) < 0.1
    assert quality["leg_heading_residual_sd_deg"] < 3
    assert report["device"] == {"Brand": "OPPO", "Model": "PBCM10", "AndroidName": "8.1.0"}
    assert any("1.2 m above the floor" in text for text in report["assumptions"])
    assert any("4 neighbouring samples were averaged" in text for text in report["assumptions"])
    assert report["warnings"] == []


def test_phone_held_across_the_way_is_noticed(walk_maker):
    known = walk_maker()
    across = re.sub(
        r"TYPE_WAYPOINT\t(\S+)\t(\S+)", lambda m: f"TYPE_WAYPOINT\t{-float(m[2])}\t{float(m[1])}", known.text
    )
    report = read(across.encode()).report
    assert any("disagrees with the phone's compass" in text for text in report["warnings"])
    assert abs(report["quality"]["holding_deg"] - 90) < 15


# Other phones and the full competition format.


def test_radio_records_are_passed_over_and_accuracy_may_be_missing(known_walk):
    expected = read(known_walk.data)
    lines = []
    for k, line in enumerate(known_walk.text.splitlines()):
        lines.append(line.removesuffix("\t3") if "_UNCALIBRATED" not in line else line)
        if k % 50 == 10:
            stamp = 1574129692000 + k
            lines.append(f"{stamp}\tTYPE_WIFI\t6b:6d\tnäme\t-55\t2412\t{stamp}")
            lines.append(f"{stamp}\tTYPE_WIFI\t6b:6d\ta name of\ntwo lines\t-55\t2412\t{stamp}")
            lines.append(f"{stamp}\tTYPE_BEACON\tuuid\t1\t2\t-59\t-70\t1.3\tmac\t{stamp}")
            lines.append(f"{stamp}\tTYPE_GYROSCOPE_UNCALIBRATED\t0.1\t0.2\t0.3\t0\t0\t0\t3")
    walk = read("\n".join(lines).encode())
    np.testing.assert_array_equal(walk.samples.B_uT, expected.samples.B_uT)
    np.testing.assert_array_equal(walk.samples.p_building_m, expected.samples.p_building_m)


def test_two_records_glued_on_one_line_are_both_read(known_walk):
    expected = read(known_walk.data)
    glued = known_walk.text.replace("\t3\n1574129692400\tTYPE_GYROSCOPE", "\t31574129692400\tTYPE_GYROSCOPE")
    assert glued != known_walk.text
    walk = read(glued.encode())
    np.testing.assert_array_equal(walk.samples.B_uT, expected.samples.B_uT)
    assert walk.report["warnings"] == ["1 lines held two records; 0 incomplete ones were dropped"]
    half = known_walk.text.replace("\t3\n1574129692400\tTYPE_GYROSCOPE", "1574129692400\tTYPE_GYROSCOPE")
    half = re.sub(r"\t[^\t]+\t[^\t]+(?=1574129692400\tTYPE_GYROSCOPE)", "", half)
    assert read(half.encode()).report["warnings"] == ["1 lines held two records; 1 incomplete ones were dropped"]


def test_sensors_at_other_rates_and_instants_are_brought_together(known_walk):
    expected = read(known_walk.data)
    lines = known_walk.text.splitlines()
    shift = {"TYPE_GYROSCOPE": 7, "TYPE_ACCELEROMETER": 3, "TYPE_ROTATION_VECTOR": 11}
    moved = []
    for line in lines:
        parts = line.split("\t")
        if len(parts) > 1 and parts[1] in shift:
            parts[0] = str(int(parts[0]) + shift[parts[1]])
        moved.append("\t".join(parts))
    walk = read(("\n".join(moved) + "\n").encode())
    np.testing.assert_allclose(walk.samples.B_uT, expected.samples.B_uT, atol=0.8)
    np.testing.assert_allclose(walk.samples.p_building_m, expected.samples.p_building_m, atol=0.2)


def test_gravity_without_a_rotation_vector(known_walk, field):
    walk = read(without(known_walk.text, "ROTATION_VECTOR").encode())
    p = truth(known_walk, walk, known_walk.p_m)
    assert np.sqrt(np.mean(np.square(walk.samples.B_uT[:, 2] - field(p)[:, 2]))) < 1.5
    assert walk.dead_reckoning.heading_rad is None
    assert any("no TYPE_ROTATION_VECTOR" in text for text in walk.report["warnings"])


def test_yaw_without_a_gyroscope_is_the_rotation_vectors(known_walk):
    walk = read(without(known_walk.text, "GYROSCOPE").encode())
    assert any("yaw from the rotation vector" in text for text in walk.report["assumptions"])


def test_calibrated_channel_alone_has_no_session(known_walk):
    expected = read(known_walk.data)
    walk = read(without(known_walk.text, "MAGNETIC_FIELD_UNCALIBRATED").encode())
    assert walk.samples.session is None
    np.testing.assert_allclose(walk.samples.B_uT, expected.samples.B_uT, atol=1e-3)
    assert any("session is unknown" in text for text in walk.report["warnings"])


def test_bias_that_jumps_is_reported_and_one_is_used(known_walk):
    lines = known_walk.text.splitlines()
    raw = [k for k, line in enumerate(lines) if "_UNCALIBRATED" in line]
    for k in raw[: len(raw) // 4]:
        parts = lines[k].split("\t")
        parts[5] = "-25.0"
        lines[k] = "\t".join(parts)
    walk = read(("\n".join(lines) + "\n").encode())
    assert walk.samples.session == "-20.0000,9.5000,-317.2500"
    assert walk.report["quality"]["bias_changes"] == 1
    np.testing.assert_array_equal(walk.samples.B_uT, read(known_walk.data).samples.B_uT)


# Bad input.


def test_a_cut_last_line_is_dropped_with_a_warning(known_walk):
    end = known_walk.text.rindex("TYPE_WAYPOINT")
    cut = known_walk.text[: known_walk.text.index("\n", end) + 1] + "1574129999999\tTYPE_ACCELEROMETER\t0.1\t0."
    assert "last line was cut" in read(cut.encode()).report["warnings"][0]


def test_damage_in_the_middle_is_refused_with_its_line(known_walk):
    lines = known_walk.text.splitlines()
    k = next(i for i, line in enumerate(lines) if i > 200 and "TYPE_GYROSCOPE" in line)
    for broken, reason in (
        ("1574129692195\tTYPE_GYROSCOPE\t0.1\t0.2", "2 values, needs 3"),
        ("1574129692195\tTYPE_GYROSCOPE\t0.1\tnan\t0.2\t3", "'nan' is not a finite number"),
        ("1574129692195\tTYPE_GYROSCOPE\t0.1\t1e99\t0.2\t3", "'1e99' is not a finite number"),
        ("\x00\x13garbage", "is no record"),
    ):
        error = refused("\n".join([*lines[:k], broken, *lines[k + 1 :]]).encode())
        assert error.faults[0].location.startswith(f"line {k + 1}")
        assert reason in error.faults[0].reason


def test_time_going_backwards_is_refused_with_its_line(known_walk):
    lines = known_walk.text.splitlines()
    k = next(i for i, line in enumerate(lines) if i > 200 and "TYPE_GYROSCOPE" in line)
    lines[k] = "1574129690000" + lines[k][13:]
    error = refused("\n".join(lines).encode())
    assert error.faults[0].location == f"line {k + 1}"
    assert "goes back" in error.faults[0].reason


def test_repeated_times_are_dropped_and_counted(known_walk):
    lines = known_walk.text.splitlines()
    k = next(i for i, line in enumerate(lines) if i > 200 and "TYPE_GYROSCOPE" in line)
    walk = read("\n".join([*lines[: k + 1], lines[k], *lines[k + 1 :], ""]).encode())
    assert walk.report["warnings"] == ["1 TYPE_GYROSCOPE records repeated a time and were dropped"]


@pytest.mark.parametrize(
    ("kinds", "reason"),
    [
        (("WAYPOINT",), "0 waypoints"),
        (("ACCELEROMETER",), "no TYPE_ACCELEROMETER"),
        (("GYROSCOPE", "ROTATION_VECTOR"), "no TYPE_GYROSCOPE"),
        (("MAGNETIC_FIELD", "MAGNETIC_FIELD_UNCALIBRATED"), "0 magnetometer samples"),
    ],
)
def test_missing_sensors_are_named(known_walk, kinds, reason):
    assert reason in str(refused(without(known_walk.text, *kinds).encode()))


def test_a_calibration_is_of_the_raw_channel_alone(known_walk):
    """The phone's own field has its bias taken off already, and which one is not known."""
    data = without(known_walk.text, "MAGNETIC_FIELD_UNCALIBRATED").encode()
    with pytest.raises(UnreadableSurvey, match="TYPE_MAGNETIC_FIELD_UNCALIBRATED"):
        read_survey(data, format="indoor-location-2020", correct=lambda B_uT: B_uT - 5.0)


def test_other_refusals(known_walk):
    assert "empty" in str(refused(b" \n"))
    assert "no trace" in str(refused(b"t_s,x_m\n1,2\n"))
    assert "no trace" in str(refused(bytes(range(256))))
    one = re.sub(r"(TYPE_WAYPOINT)", r"\1", known_walk.text)
    head = one[: one.index("TYPE_WAYPOINT", one.index("TYPE_WAYPOINT") + 5) - 20]
    assert "1 waypoint," in str(refused(head.encode()))
    far = known_walk.text.replace("TYPE_WAYPOINT\t0.0\t0.0", "TYPE_WAYPOINT\t30.2\t12031889.5")
    assert "not a finite number" in str(refused(far.encode()))
    far = known_walk.text.replace("TYPE_WAYPOINT\t0.0\t0.0", "TYPE_WAYPOINT\t120190.2\t30300.1")
    assert "not on a floor plan" in str(refused(far.encode()))
    tesla = re.sub(
        r"(TYPE_MAGNETIC_FIELD_UNCALIBRATED\t)(\S+)\t(\S+)\t(\S+)\t(\S+)\t(\S+)\t(\S+)",
        lambda m: m[1] + "\t".join(str(float(x) * 1000) for x in m.groups()[1:]),
        known_walk.text,
    )
    assert "nanotesla" in str(refused(tesla.encode()))


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    edits=st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=6)), max_size=4),
    cut=st.floats(0, 1.3),
)
def test_damaged_traces_never_break_the_reader(known_walk, edits, cut):
    data = bytearray(known_walk.data)
    for place, change in edits:
        at = int(place * (len(data) - 1))
        data[at : at + len(change)] = change
    del data[int(min(cut, 1.0) * len(data)) :]
    with contextlib.suppress(UnreadableSurvey):
        walk = read(bytes(data))
        assert np.isfinite(walk.samples.B_uT).all()
        assert np.isfinite(walk.samples.p_building_m).all()


# Real walks.


@pytest.mark.real_data
@pytest.mark.skipif(not REAL.is_dir(), reason=f"real walks are not at {REAL}: set ISODYN_TEST_DATA")
def test_real_walks_are_read_whole():
    files = sorted(REAL.glob("*/*.txt.gz"))[::9]
    assert len(files) >= 4
    scales, residuals = [], []
    for file in files:
        walk = read(gzip.decompress(file.read_bytes()))
        quality = walk.report["quality"]
        assert 9 < walk.report["rate_hz"] < 26
        assert quality["waypoints"] >= 2
        assert walk.samples.session is not None
        norm = np.linalg.norm(walk.samples.B_uT, axis=1)
        assert 15 < np.median(norm) < 90
        if quality["leg_scale_median"] is not None:
            scales.append(quality["leg_scale_median"])
        residuals.append(quality["yaw_offset_sd_deg"])
        p = walk.samples.p_building_m[:, :2]
        steps = np.linalg.norm(np.diff(p, axis=0), axis=1) / np.diff(walk.samples.t_s)
        assert np.percentile(steps, 99) < 3.0
    assert 0.9 < np.median(scales) < 1.1
    assert np.median(residuals) < 8
