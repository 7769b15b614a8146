"""Canonical surveys: three formats with one meaning, and a reason for every refusal."""

import contextlib
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from app.errors import TooLarge, UnreadableSurvey
from app.geometry import rotate_by_quaternion
from app.survey import columns as columns_module
from app.survey.read import FORMATS, read_survey

PLAIN = ("t_s", "x_m", "y_m", "z_m", "bx_ut", "by_ut", "bz_ut")


def plain(table):
    return {name: table[name].copy() for name in PLAIN}


def refused(data, format, **options):
    with pytest.raises(UnreadableSurvey) as caught:
        read_survey(data, format=format, **options)
    assert caught.value.faults
    assert len(caught.value.faults) <= 20
    return caught.value


def test_plain_table_is_in_the_frame_asked_for(table, written):
    format, write = written
    columns = plain(table)
    for frame in ("building", "level"):
        walk = read_survey(write(columns), format=format, frame=frame)
        assert walk.samples.frame == frame
        assert walk.samples.q_body_to_building is None
        np.testing.assert_array_equal(walk.samples.t_s, columns["t_s"])
        np.testing.assert_array_equal(walk.samples.p_building_m.T, [columns[k] for k in ("x_m", "y_m", "z_m")])
        np.testing.assert_array_equal(walk.samples.B_uT.T, [columns[k] for k in ("bx_ut", "by_ut", "bz_ut")])


def test_body_field_is_rotated_by_its_quaternion(table, written):
    format, write = written
    walk = read_survey(write(table), format=format)
    q = np.stack([table[k] for k in ("qw", "qx", "qy", "qz")], axis=1)
    b = np.stack([table[k] for k in ("bx_ut", "by_ut", "bz_ut")], axis=1)
    np.testing.assert_allclose(walk.samples.B_uT, rotate_by_quaternion(q, b), atol=1e-12)
    np.testing.assert_allclose(walk.samples.q_body_to_building, q, atol=1e-12)
    assert "body frame" in walk.report["assumptions"][0]


def test_quaternions_decide_over_the_frame_and_the_report_says_so(table, writers):
    walk = read_survey(writers["csv"](table), format="csv", frame="level")
    assert walk.samples.frame == "building"
    assert any("frame=level was ignored" in text for text in walk.report["assumptions"])


def test_a_table_with_quaternions_may_say_its_calibration_session(table, written):
    format, write = written
    walk = read_survey(write(table), format=format, session="robot-7 monday")
    assert walk.samples.session == walk.report["session"] == "robot-7 monday"
    assert read_survey(write(table), format=format).samples.session is None
    error = refused(write(plain(table)), format, session="robot-7 monday")
    assert error.faults[0].location == "session"
    assert "qw,qx,qy,qz" in str(error)


def test_a_trace_says_its_session_itself():
    assert "itself" in str(refused(b"", "indoor-location-2020", session="monday"))


def test_norm_is_the_length_of_three_columns_or_one_column(table, written):
    format, write = written
    columns = plain(table)
    norm = np.linalg.norm([columns[k] for k in ("bx_ut", "by_ut", "bz_ut")], axis=0)
    walk = read_survey(write(columns), format=format, frame="norm")
    np.testing.assert_allclose(walk.samples.B_uT[:, 0], norm)
    for name in ("b_ut", "bx_ut"):
        single = {k: columns[k] for k in PLAIN[:4]} | {name: norm}
        assert read_survey(write(single), format=format, frame="norm").samples.B_uT.shape == (30, 1)


def test_quaternions_off_by_rounding_are_normalised(table, writers):
    table["qw"] *= 1.01
    walk = read_survey(writers["csv"](table), format="csv")
    np.testing.assert_allclose(np.linalg.norm(walk.samples.q_body_to_building, axis=1), 1.0)
    assert any("normalised" in text for text in walk.report["assumptions"])


finite = st.floats(-90, 90, allow_nan=False)


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    steps=npst.arrays(float, st.integers(2, 30), elements=st.floats(1e-6, 1e3)),
    start_s=st.floats(-1e9, 2e9),
    scatter=st.integers(0, 2**32 - 1),
)
def test_three_formats_mean_the_same(writers, steps, start_s, scatter):
    rng = np.random.default_rng(scatter)
    n = len(steps)
    t_s = start_s + np.cumsum(steps)
    if np.any(np.diff(t_s) <= 0):
        return
    columns = dict(zip(PLAIN, [t_s, *rng.uniform(-3, 3, (3, n)), *rng.uniform(10, 60, (3, n))], strict=True))
    walks = [read_survey(write(columns), format=format) for format, write in writers.items()]
    for walk in walks:
        np.testing.assert_array_equal(walk.samples.t_s, t_s)
        np.testing.assert_array_equal(walk.samples.p_building_m, walks[0].samples.p_building_m)
        np.testing.assert_array_equal(walk.samples.B_uT, walks[0].samples.B_uT)


def test_csv_variants_people_write(table, writers):
    columns = plain(table)
    expected = read_survey(writers["csv"](columns), format="csv").samples
    text = writers["csv"](columns).decode()
    names = ",".join(PLAIN)
    spaced = text.replace(names, ", ".join(PLAIN)).replace("\n", "\r\n\r\n")
    quoted = text.replace(names, ",".join(f'"{name}"' for name in PLAIN))
    shuffled = writers["csv"]({"note": np.zeros(30), **dict(reversed(columns.items()))}).decode()
    for variant in (spaced, quoted, shuffled, "\ufeff" + text, text.rstrip("\n")):
        samples = read_survey(variant.encode(), format="csv").samples
        np.testing.assert_array_equal(samples.B_uT, expected.B_uT)
        np.testing.assert_array_equal(samples.t_s, expected.t_s)


def test_report_describes_the_walk(table, written):
    format, write = written
    columns = plain(table)
    columns["t_s"][20:] += 7.0
    report = read_survey(write(columns), format=format).report
    assert report["samples"] == 30
    assert report["rate_hz"] == pytest.approx(10.0)
    assert report["gaps"] == {"count": 1, "longest_s": 7.1}
    assert any("gap" in text for text in report["warnings"])
    assert 15 < report["b_norm_ut"]["p50"] < 65


def test_standing_still_is_measured(table, writers):
    columns = plain(table)
    columns["t_s"] = np.arange(30.0)
    columns |= {"x_m": np.minimum(np.arange(30.0), 15.0), "y_m": np.zeros(30), "z_m": np.zeros(30)}
    report = read_survey(writers["csv"](columns), format="csv").report
    assert report["stationary_share"] == pytest.approx(14 / 29, abs=0.01)


# Bad input: each is refused, with where and why.


def test_missing_columns_are_named_with_what_was_found(table, written):
    format, write = written
    columns = plain(table)
    columns["bx"] = columns.pop("bx_ut")
    error = refused(write(columns), format)
    assert "lacks the column bx_ut" in str(error)
    assert "t_s, x_m, y_m, z_m, by_ut, bz_ut, bx" in str(error)


def test_half_a_quaternion_is_missing_columns(table, written):
    format, write = written
    del table["qz"]
    assert "lacks the column qz" in str(refused(write(table), format))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite(table, written, value):
    format, write = written
    columns = plain(table)
    columns["y_m"][4] = value
    error = refused(write(columns), format)
    place = {"csv": "line 6", "ndjson": "line 5", "parquet": "row 5"}[format]
    assert error.faults[0].location == f"{place}, column y_m"
    assert "not finite" in error.faults[0].reason


@pytest.mark.parametrize(("step_s", "word"), [(0.0, "repeats"), (-1.0, "goes back")])
def test_time_that_does_not_increase(table, written, step_s, word):
    format, write = written
    columns = plain(table)
    columns["t_s"][9] = columns["t_s"][8] + step_s
    error = refused(write(columns), format)
    place = {"csv": "line 11", "ndjson": "line 10", "parquet": "row 10"}[format]
    assert error.faults[0].location == f"{place}, column t_s"
    assert word in error.faults[0].reason


@pytest.mark.parametrize(
    ("factor", "guess"),
    [
        (1000.0, "nanotesla: divide by 1,000"),
        (10.0, "milligauss: divide by 10"),
        (0.01, "gauss: multiply by 100"),
        (1e-3, "millitesla: multiply by 1,000"),
        (1e-6, "tesla: multiply by 1,000,000"),
    ],
)
def test_wrong_unit_is_named(table, written, factor, guess):
    format, write = written
    columns = plain(table)
    for name in ("bx_ut", "by_ut", "bz_ut"):
        columns[name] *= factor
    assert guess in str(refused(write(columns), format))


def test_fifty_thousand_looks_like_nanotesla(table, writers):
    columns = plain(table)
    columns |= {"bx_ut": np.full(30, 0.0), "by_ut": np.full(30, 0.0), "bz_ut": np.full(30, 50_000.0)}
    error = refused(writers["csv"](columns), "csv")
    assert "50,000 looks like nanotesla: divide by 1,000" in str(error)
    assert error.faults[0].location == "line 2"


def test_a_single_saturated_reading_is_located(table, writers):
    columns = plain(table)
    columns["bz_ut"][3] = 4912.0
    columns["bz_ut"][5] = 0.1
    columns["bx_ut"][5] = columns["by_ut"][5] = 0.0
    error = refused(writers["csv"](columns), "csv")
    assert [fault.location for fault in error.faults] == ["line 5", "line 7"]
    assert "outside 1-2,000 uT" in error.faults[0].reason


@pytest.mark.parametrize(("factor", "word"), [(0.0, "zero quaternion"), (1.5, "length 1.5")])
def test_quaternions_that_are_no_rotations(table, written, factor, word):
    format, write = written
    for name in ("qw", "qx", "qy", "qz"):
        table[name][2] *= factor
    error = refused(write(table), format)
    assert word in error.faults[0].reason
    assert len(error.faults) == 1


def test_coordinates_that_are_no_building(table, written):
    format, write = written
    columns = plain(table)
    columns["x_m"] += 326_000.0
    error = refused(write(columns), format)
    assert "subtract the origin" in error.faults[0].reason
    assert len(error.faults) == 20


def test_a_jump_across_the_building(table, writers):
    columns = plain(table)
    columns["x_m"][7:] += 3000.0
    error = refused(writers["csv"](columns), "csv")
    assert error.faults[0].location == "line 9"
    assert "jump of 3,0" in error.faults[0].reason


def test_empty_header_only_and_single_sample(table, written):
    format, write = written
    columns = plain(table)
    assert "empty" in str(refused(b"", format))
    assert "single sample" in str(refused(write({k: v[:1] for k, v in columns.items()}), format))
    if format != "ndjson":
        assert "no samples" in str(refused(write({k: v[:0] for k, v in columns.items()}), format))


@pytest.mark.parametrize("format", ["csv", "ndjson"])
def test_text_that_is_not_utf8(format, writers, table):
    data = writers[format](plain(table)).replace(b"x_m", b"x\xff_m", 1)
    error = refused(data, format)
    assert "not UTF-8" in str(error)
    assert error.faults[0].location == "line 1"
    assert "zero byte" in str(refused("t_s,x_m\n1,2\n".encode("utf-16-le"), format))


def test_truncated_text_says_where(table, writers):
    data = writers["csv"](plain(table))
    error = refused(data[: data.rindex(b",")], "csv")
    assert error.faults[0].location == "line 31"
    assert "truncated" in error.faults[0].reason
    data = writers["ndjson"](plain(table))
    error = refused(data[:-20], "ndjson")
    assert error.faults[0].location == "line 30"
    assert "truncated" in error.faults[0].reason


def test_truncated_parquet(table, writers):
    data = writers["parquet"](plain(table))
    assert "cut" in str(refused(data[:-10], "parquet"))
    assert "corrupt" in str(refused(data[:40] + data[-40:], "parquet"))


def test_words_in_place_of_numbers_are_all_listed(table, writers):
    lines = writers["csv"](plain(table)).decode().splitlines()
    for k in (3, 5):
        lines[k] = lines[k].rsplit(",", 1)[0] + ",n/a"
    error = refused("\n".join(lines).encode(), "csv")
    assert [fault.location for fault in error.faults] == ["line 4, column bz_ut", "line 6, column bz_ut"]
    assert "'n/a' is not a number" in error.faults[0].reason


def test_empty_cells_are_no_numbers(table, writers):
    lines = writers["csv"](plain(table)).decode().splitlines()
    lines[3] = lines[3].rsplit(",", 1)[0] + ","
    assert refused("\n".join(lines).encode(), "csv").faults[0].location == "line 4, column bz_ut"


def test_other_separators_and_repeated_columns(table, writers):
    data = writers["csv"](plain(table))
    assert "semicolons" in str(refused(data.replace(b",", b";"), "csv"))
    assert "tabs" in str(refused(data.replace(b",", b"\t"), "csv"))
    assert "twice" in str(refused(data.replace(b"y_m", b"x_m", 1), "csv"))


def test_ndjson_values_that_are_no_numbers(table, writers):
    lines = writers["ndjson"](plain(table)).decode().splitlines()
    lines[1] = lines[1].replace('"x_m": ', '"x_m": "1", "ignored": ')
    lines[2] = "[1, 2]"
    lines[3] = lines[3].replace('"x_m": ', '"x_m": true, "ignored": ')
    lines[4] = lines[4].replace('"x_m": ', '"x": ')
    lines[5] = "[" * 100_000
    error = refused("\n".join(lines).encode(), "ndjson")
    assert [fault.location for fault in error.faults] == [
        "line 2, column x_m", "line 3", "line 4, column x_m", "line 5, column x_m", "line 6"
    ]  # fmt: skip


def test_parquet_columns_that_are_no_numbers(table, writers):
    columns = plain(table) | {"bz_ut": np.array(["a"] * 30)}
    assert "column bz_ut holds string" in str(refused(writers["parquet"](columns), "parquet"))


def test_unknown_format_and_frame_list_the_known():
    assert all(name in str(refused(b"x", "matlab")) for name in FORMATS)
    assert "building, level, norm" in str(refused(b"x", "csv", frame="sensor"))


def test_too_many_samples_are_refused_before_they_are_read(table, written, monkeypatch):
    format, write = written
    monkeypatch.setattr(columns_module, "MAX_SAMPLES", 20)
    with pytest.raises(TooLarge, match="may have 20 samples"):
        read_survey(write(plain(table)), format=format)


# Whatever the bytes are, nothing but UnreadableSurvey leaves the reader.


def read_or_refuse(data, format):
    with contextlib.suppress(UnreadableSurvey):
        assert len(read_survey(data, format=format).samples) >= 2


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=300), st.sampled_from(FORMATS))
def test_random_bytes_never_break_a_reader(data, format):
    read_or_refuse(data, format)


@settings(max_examples=150, deadline=None)
@given(st.text(st.sampled_from("0123456789.,-+eEnaif\"'\n\r\t {}[]:x_"), max_size=200), st.sampled_from(FORMATS))
def test_random_rows_never_break_a_reader(text, format):
    header = "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n" if format == "csv" else ""
    read_or_refuse((header + text).encode(), format)


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(edits=st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=4)), min_size=1, max_size=4), cut=st.floats(0, 1))
def test_damaged_files_never_break_a_reader(table, writers, edits, cut):
    for format, write in writers.items():
        data = bytearray(write(table))
        for place, change in edits:
            at = int(place * (len(data) - 1))
            data[at : at + len(change)] = change
        if cut < 0.3:
            del data[int(cut / 0.3 * len(data)) :]
        read_or_refuse(bytes(data), format)


@pytest.mark.parametrize("format", ["csv", "parquet"])
def test_a_first_survey_does_not_wait_for_pandas(table, writers, format):
    """Arrow would load it to hand over a column, where it is installed, in the thread that answers the upload."""
    reading = (
        "import sys\n"
        "from app.survey.read import read_survey\n"
        f"read_survey(sys.stdin.buffer.read(), format={format!r})\n"
        "sys.exit('pandas' in sys.modules)"
    )
    data = writers[format](plain(table))
    assert subprocess.run([sys.executable, "-c", reading], input=data, timeout=120, check=False).returncode == 0
