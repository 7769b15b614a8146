"""Where a log went wrong, on errors made to order: an offset that switches, a disturbed stretch, a steady walk."""

import numpy as np
import pytest

from app.field.change_point import CHANGE_CHANCE, find_change
from app.field.leave_one_out import HeldOut
from app.synthetic.noise import ornstein_uhlenbeck

NAMES = ("bx", "by", "bz")
STEP_M = 0.1


def steady(seed, length_m=100.0, correlation_m=1.0, sd_uT=2.0, components=3):
    """Calibrated errors, most of their variance correlated along the path."""
    rng = np.random.default_rng(seed)
    path_m = STEP_M * np.arange(round(length_m / STEP_M))
    slow = ornstein_uhlenbeck(rng, path_m, 0.9, correlation_m, components)
    z = slow + np.sqrt(0.19) * rng.normal(size=slow.shape)
    return HeldOut(sd_uT * z, np.full_like(z, sd_uT), np.ones(len(z), dtype=bool), path_m)


@pytest.mark.parametrize("seed", range(5))
def test_an_offset_that_switches_is_found_where_it_does(seed):
    h = steady(seed)
    h.error_uT[620:, 2] += 8.0
    change = find_change(h, NAMES, 1.0)
    assert change.sample == pytest.approx(620, abs=20)
    assert change.path_m == pytest.approx(62.0, abs=2.0)
    assert change.until_sample is None and change.until_path_m is None  # noqa: PT018
    assert change.p_value < CHANGE_CHANCE
    (bz,) = change.components
    assert bz.component == "bz"
    assert bz.mean_after_ut - bz.mean_before_ut == pytest.approx(8.0, abs=2.0)
    assert bz.sd_after_ut == pytest.approx(bz.sd_before_ut, rel=0.5)


def test_an_offset_that_ends_is_the_same_change_backwards():
    h = steady(1)
    h.error_uT[:300, 0] += 8.0
    change = find_change(h, NAMES, 1.0)
    assert change.sample == pytest.approx(300, abs=20)
    assert change.until_sample is None
    assert change.components[0].mean_before_ut > change.components[0].mean_after_ut + 5.0


@pytest.mark.parametrize("seed", range(5))
def test_a_disturbed_stretch_is_found_with_both_ends(seed):
    h = steady(seed, correlation_m=0.5)
    h.error_uT[400:550] += [10.0, -10.0, 0.0]
    change = find_change(h, NAMES, 0.5)
    assert (change.sample, change.until_sample) == pytest.approx((400, 550), abs=20)
    assert {c.component for c in change.components} == {"bx", "by"}


def test_a_stretch_that_only_becomes_rough_is_found_by_its_spread():
    h = steady(2, length_m=200.0, correlation_m=0.3)
    h.error_uT[1000:] *= 4.0
    change = find_change(h, NAMES, 0.3)
    assert change.sample == pytest.approx(1000, abs=50)
    assert all(c.sd_after_ut > 2.5 * c.sd_before_ut for c in change.components)


@pytest.mark.parametrize(("correlation_m", "length_m"), [(0.3, 60.0), (1.5, 150.0), (4.0, 150.0)])
def test_steady_walks_raise_hardly_any_false_alarm(correlation_m, length_m):
    walks = [steady(seed, length_m, correlation_m) for seed in range(100)]
    alarms = sum(find_change(walk, NAMES, correlation_m) is not None for walk in walks)
    assert alarms <= 1  # of 100; one in a thousand is asked for


def test_correlated_errors_taken_for_independent_would_raise_many():
    alarms = sum(find_change(steady(seed, 150.0, 4.0), NAMES, 0.1) is not None for seed in range(20))
    assert alarms >= 10


def test_samples_that_cannot_be_judged_are_passed_over():
    h = steady(3)
    h.error_uT[400:600] = 1e3
    judged = h.judged.copy()
    judged[400:600] = False
    assert find_change(HeldOut(h.error_uT, h.sd_uT, judged, h.path_m), NAMES, 1.0) is None
    h.error_uT[600:, 1] += 8.0
    change = find_change(HeldOut(h.error_uT, h.sd_uT, judged, h.path_m), NAMES, 1.0)
    assert 600 <= change.sample <= 620


def test_a_short_or_unjudged_walk_has_no_change():
    h = steady(0, length_m=5.0)
    h.error_uT[25:] += 50.0
    assert find_change(h, NAMES, 1.0) is None  # two stretches of four correlation lengths do not fit
    nothing = HeldOut(h.error_uT, h.sd_uT, np.zeros(len(h.path_m), dtype=bool), h.path_m)
    assert find_change(nothing, NAMES, 1.0) is None


def test_standing_still_does_not_make_a_change():
    """A thousand samples at one place are one error, however large the offset there happens to be."""
    h = steady(4)
    stood = np.insert(np.arange(len(h.path_m)), 500, np.full(3000, 500))
    still = HeldOut(h.error_uT[stood], h.sd_uT[stood], h.judged[stood], h.path_m[stood])
    still.error_uT[500:3500] += 3.0
    assert find_change(still, NAMES, 1.0) is None
