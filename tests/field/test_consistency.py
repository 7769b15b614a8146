"""Kuevor B14: a clean survey passes, a corrupted stretch is found where it is."""

from dataclasses import replace

import numpy as np
import pytest

from app.field import consistency
from app.field.consistency import check_consistency, check_surveys
from app.field.fit import fit_map
from app.field.leave_one_out import HeldOut
from app.field.spec import MapSpec

SPEC = MapSpec(resolution_m=0.5)


@pytest.fixture(scope="module")
def walks(room_of_module):
    return room_of_module.lanes(np.random.default_rng(1))


@pytest.fixture(scope="module")
def room_of_module(make_room):
    return make_room(7)


def bad_segments(report):
    return [s for s in report.segments if not s.consistent]


def test_clean_surveys_are_consistent(walks):
    reports = fit_map(walks, SPEC).consistency
    assert {r.status for r in reports.values()} == {"consistent"}
    assert all(c.p_value > 1e-3 for r in reports.values() for c in r.components)
    assert all(r.change_point is None for r in reports.values())


def test_an_offset_from_the_middle_on_is_found_there(walks):
    victim = walks["survey-2"]
    field = victim.B_uT.copy()
    middle = len(victim) // 2
    field[middle:] += [5.0, 0.0, 0.0]
    report = fit_map(walks | {"survey-2": replace(victim, B_uT=field)}, SPEC).consistency["survey-2"]
    assert report.status == "inconsistent"
    assert report.seed_2sigma_96 is False
    assert bad_segments(report)
    assert all(s.stop > middle for s in bad_segments(report))
    assert all(not s.consistent for s in report.segments if s.start >= middle)
    assert report.change_point.sample == pytest.approx(middle, abs=20)
    assert report.change_point.components[0].component == "bx"
    bx, by, _ = report.components
    assert bx.p_value < 0.05 < by.p_value


def test_a_stretch_turned_by_a_right_angle_is_found(walks):
    victim = walks["survey-1"]
    field = victim.B_uT.copy()
    third = len(victim) // 3
    field[:third] = np.column_stack([-field[:third, 1], field[:third, 0], field[:third, 2]])
    report = fit_map(walks | {"survey-1": replace(victim, B_uT=field)}, SPEC).consistency["survey-1"]
    assert report.status == "inconsistent"
    assert all(not s.consistent for s in report.segments if s.stop <= third)
    assert all(s.start < third for s in bad_segments(report))
    assert report.change_point.sample == pytest.approx(third, abs=20)
    assert {c.component for c in report.change_point.components} >= {"bx", "by"}


def test_a_survey_far_from_the_others_is_unjudged(make_room):
    room = make_room(3)
    rng = np.random.default_rng(0)
    walks = {
        "near": room.walk(rng, np.array([[0.0, 1.0], [10.0, 1.0]])),
        "far": room.walk(rng, np.array([[0.0, 8.0], [10.0, 8.0]])),
    }
    fitted = fit_map(walks, SPEC)
    assert {r.status for r in fitted.consistency.values()} == {"unjudged"}
    assert all("again" in r.reason for r in fitted.consistency.values())
    assert fitted.score is None
    assert "twice" in fitted.score_reason


def test_the_p_value_accounts_for_correlation():
    n = 400
    error = np.zeros((n, 1))
    error[:40] = 3.0  # coverage 0.9: forty independent failures, or one long one
    held_out = HeldOut(error, np.ones((n, 1)), np.ones(n, dtype=bool), 0.1 * np.arange(n))
    independent = check_consistency(held_out, ("norm",), 0.0).components[0].p_value
    correlated = check_consistency(held_out, ("norm",), 5.0).components[0].p_value
    assert independent < 1e-4
    assert correlated > 0.05


@pytest.mark.parametrize("counts", [(30, 40, 51), (0, 30, 41), (25,)])
def test_every_survey_is_judged_by_the_sds_the_others_show(counts):
    rng = np.random.default_rng(0)
    held_out = {
        str(k): HeldOut(
            0.1 * (k + 1) * rng.normal(size=(n, 2)), np.ones((n, 2)), np.ones(n, dtype=bool), np.arange(float(n))
        )
        for k, n in enumerate(counts)
    }
    reports = check_surveys(held_out, ("horizontal", "vertical"), 0.0)
    for name, own in held_out.items():
        others = [np.abs(h.error_uT) for other, h in held_out.items() if other != name and len(h.error_uT)]
        shown = np.clip(1.5 * 1.4826 * np.median(np.concatenate(others), axis=0), 1e-3, 1.0) if others else np.ones(2)
        if len(own.error_uT):
            assert [c.mean_sd_ut for c in reports[name].components] == pytest.approx(shown)


def test_counting_tells_when_no_sd_comes_down(monkeypatch):
    rng = np.random.default_rng(1)
    n = 40

    def reports(spread):
        walks = {
            str(k): HeldOut(
                spread * rng.normal(size=(n, 1)), np.ones((n, 1)), np.ones(n, dtype=bool), np.arange(float(n))
            )
            for k in range(4)
        }
        counted = check_surveys(walks, ("norm",), 0.0)
        with monkeypatch.context() as patched:
            patched.setattr(consistency, "count_below", lambda *_: np.full(1, n))  # so that medians are taken
            return counted, check_surveys(walks, ("norm",), 0.0)

    for spread in (0.5, 0.65, 0.7, 0.75, 1.0, 2.0):
        counted, by_medians = reports(spread)
        assert counted == by_medians
