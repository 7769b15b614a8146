"""The benchmark of ten floors in small: its windows are what they say, and its figures what they should be."""

import numpy as np
import pytest

from app.geometry import yaw_matrix
from app.positioning.fix import LocateOptions


@pytest.fixture(scope="module")
def ten_floors(benchmark_named):
    return benchmark_named("ten_floors")


@pytest.fixture(scope="module")
def storeys(ten_floors):
    rng = np.random.default_rng(0)
    return [ten_floors.make_storey(rng, 30.0, 0.0) for _ in range(3)]


def test_a_map_errs_by_what_it_states(ten_floors, storeys):
    for storey in storeys:
        error = storey.surveyed.mean_uT - storey.truth.mean_uT
        assert np.allclose(error.std(axis=(0, 1, 2)), ten_floors.MAP_SD_UT, rtol=1e-3)
        assert np.allclose(storey.truth.mean_uT.std(axis=(0, 1, 2)), ten_floors.FIELD_SD_UT, rtol=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_a_window_put_back_where_it_was_walked_reads_the_field(ten_floors, storeys, seed):
    """By the truth alone: without drift one turn takes the whole window back to the building."""
    walked = ten_floors.walk(np.random.default_rng(seed), storeys, 40, 0.0, 0.0)
    told, B = walked.window.displacement_m, walked.window.B_uT
    length_m = np.linalg.norm(np.diff(told[:, :2], axis=0), axis=1).sum()
    assert abs(length_m / ten_floors.LENGTH_M - 1.0) <= ten_floors.MOST_SCALE + 1e-9
    scale = ten_floors.LENGTH_M / length_m
    rms_uT = []
    for yaw in np.linspace(-np.pi, np.pi, 721):
        turn = yaw_matrix(yaw)
        p = walked.end_m + scale * ((told - told[-1]) @ turn.T)[:, :2]
        off = storeys[walked.floor].truth.at(p).mean_uT - B @ turn.T
        rms_uT.append(float(np.sqrt(np.mean(np.square(off)))))
    assert min(rms_uT) == pytest.approx(ten_floors.SENSOR_NOISE_UT, abs=0.15)


def test_windows_are_located_among_any_number_of_floors(ten_floors, storeys):
    rng = np.random.default_rng(1)
    windows = [ten_floors.walk(rng, storeys, 20, 0.3, 0.0) for _ in range(2)]
    answers = ten_floors.located(storeys, windows, (1, 3), LocateOptions())
    assert [each.floors for each in answers] == [1, 3, 1, 3]
    assert all(each.right_floor and each.error_m < 1.5 for each in answers)
    assert ten_floors.report(answers) in (0, 1)


def test_both_targets_decide(ten_floors, capsys):
    def answers(error_m, cpu_s):
        return [
            ten_floors.Answer(floors, True, error_m, 0.6, floors * cpu_s ** (floors > 1), True)
            for _ in range(20)
            for floors in (1, 10)
        ]

    assert ten_floors.report(answers(0.4, 0.9)) == 0
    assert ten_floors.report(answers(0.6, 0.9)) == 1
    assert ten_floors.report(answers(0.4, 1.1)) == 1
    assert capsys.readouterr().out.count("FAIL") == 2
