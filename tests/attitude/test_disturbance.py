"""The test of the magnitude, the rule for runs, and events: scripted sequences, a naive second watch, and chance."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

from app.attitude.disturbance import (
    CHANCE,
    MagnitudeState,
    OutlierRule,
    adapted_variance,
    critical_value,
    detection_power,
    innovation_statistic,
    watch,
)
from app.attitude.magnitude_log import follow_magnitude
from app.errors import InvalidInput

DEFAULT = OutlierRule()


def found_at(outliers, rule=DEFAULT, interval_s=0.02, times=None):
    """Indices at which the rule is satisfied, of a script of outcomes against a prediction that stays."""
    rule = rule._replace(adapting=False)
    state, found = MagnitudeState(), []
    for k, outlier in enumerate(outliers):
        t = k * interval_s if times is None else times[k]
        seen = watch(state, rule, t, 10.0 if outlier else 0.0, 1.0, 0.0, 0.0)
        state = seen.state
        assert seen.outlier == outlier
        if seen.found:
            found.append(k)
    return found


def test_critical_values():
    """9.000 and 14.156 (Brommer, by L175); a scalar held against the latter is rejected in 0.017 %."""
    assert pytest.approx(2 * norm.sf(3.0)) == CHANCE
    assert critical_value() == pytest.approx(9.0)
    assert critical_value(3) == pytest.approx(14.156, abs=1e-3)
    assert 2 * norm.sf(np.sqrt(critical_value(3))) == pytest.approx(0.00017, abs=1e-5)


def test_the_eleventh_outlier_in_a_row_by_default_and_the_tenth_if_asked():
    assert found_at([1] * 10 + [0]) == []
    assert found_at([1] * 11) == [10]
    assert found_at([1] * 10, OutlierRule(10, 10)) == [9]
    assert found_at([1] * 10 + [0] + [1] * 10) == []


def test_some_of_many():
    rule = OutlierRule(needed=8, window=11)
    assert found_at([1, 1, 0, 1, 1, 0, 1, 1, 0, 1, 1], rule) == [10]
    assert found_at([1, 1, 0, 1, 1, 0, 1, 0, 0, 1, 1], rule) == []
    assert found_at([1] * 7 + [0] * 4 + [1] * 7, rule) == []


def test_a_duration_at_any_rate():
    lasting = OutlierRule(lasting_s=0.2)
    assert found_at([1] * 12, lasting, 1 / 50)[0] == 10
    assert found_at([1] * 14, lasting, 1 / 60)[0] == 12
    assert found_at([1] * 5, lasting, 0.1)[0] == 2
    assert found_at([1] * 5, lasting, 0.5)[0] == 2  # three at least
    assert found_at([1, 1, 1, 0, 1, 1, 1], lasting, 0.08) == []


def test_irregular_times_and_gaps():
    lasting = OutlierRule(lasting_s=0.2)
    assert found_at([1, 1, 1, 1], lasting, times=[0.0, 0.01, 0.05, 0.21]) == [3]
    assert found_at([1, 1, 1, 1], lasting, times=[0.0, 0.1, 1.3, 1.4]) == []  # nothing is known of the second between
    assert found_at([1] * 12, times=[*np.arange(6) * 0.02, *(5.0 + np.arange(6) * 0.02)]) == []


class NaiveWatch:
    """The rule again, over the list of all outcomes."""

    def __init__(self, rule):
        self.rule, self.outcomes = rule, []

    def step(self, t, outlier):
        if self.outcomes and t - self.outcomes[-1][0] > self.rule.longest_gap_s:
            self.outcomes.clear()
        self.outcomes.append((t, outlier))
        if self.rule.lasting_s > 0.0:
            run = []
            for time, failed in reversed(self.outcomes):
                if not failed:
                    break
                run.append(time)
            return len(run) >= 3 and run[0] - run[-1] >= self.rule.lasting_s - 1e-9
        latest = [failed for _, failed in self.outcomes[-self.rule.window :]]
        return bool(outlier) and sum(latest) >= self.rule.needed


@given(
    st.lists(st.tuples(st.sampled_from([0.02, 0.05, 1.5]), st.sampled_from([0, 1, 1])), max_size=60),
    st.sampled_from([OutlierRule(), OutlierRule(3, 5), OutlierRule(4, 4), OutlierRule(lasting_s=0.1)]),
)
def test_the_watch_is_the_naive_one(script, rule):
    naive = NaiveWatch(rule)
    times = np.cumsum([gap for gap, _ in script]).tolist()
    expected = [k for k, (t, (_, o)) in enumerate(zip(times, script, strict=True)) if naive.step(t, o)]
    assert found_at([o for _, o in script], rule, times=times) == expected


def test_a_state_can_be_stored_and_taken_up():
    import json

    rng = np.random.default_rng(0)
    readings = np.concatenate([rng.normal(50, 0.5, 40), rng.normal(60, 0.5, 40), rng.normal(50, 0.5, 40)])
    state = stored = MagnitudeState()
    for k, reading in enumerate(readings):
        state = watch(state, OutlierRule(), 0.02 * k, reading, 0.25, 50.0, 0.1).state
        stored = MagnitudeState(**json.loads(json.dumps(stored._asdict())))
        stored = watch(stored, OutlierRule(), 0.02 * k, reading, 0.25, 50.0, 0.1).state
        assert stored == state


def test_the_compiled_watch_is_the_plain_one():
    rng = np.random.default_rng(2)
    for rule in (OutlierRule(), OutlierRule(3, 6), OutlierRule(lasting_s=0.1, settles_after_s=1.0)):
        state = MagnitudeState()
        for k in range(200):
            arguments = (state, rule, 0.02 * k, 50 + 4 * rng.normal() * (k % 50 > 20), 0.25, 50.0, 0.1)
            compiled, plain = watch(*arguments), watch.py_func(*arguments)
            assert compiled == plain
            state = compiled.state


def test_events_against_a_map_begin_with_their_first_outlier_and_end_when_readings_agree():
    t = np.arange(300) * 0.02
    shift = np.where((t >= 2.0) & (t < 4.0), 8.0, 0.0)
    log = follow_magnitude(t, 50.0 + shift, 0.25, start=(50.0, 0.01), adapt=False)
    (event,) = log.events
    assert event.start_s == pytest.approx(2.0)
    assert event.found_s == pytest.approx(2.2)
    assert event.end_s == pytest.approx(4.0)
    assert event.returned
    assert event.shift_uT == pytest.approx(8.0)
    assert event.before_uT == pytest.approx(50.0)
    np.testing.assert_array_equal(log.disturbed, (t >= 2.2 - 1e-9) & (t < 4.2 - 1e-9))


def test_a_belief_takes_the_new_field_in_and_the_event_ends_when_the_old_one_is_back():
    rng = np.random.default_rng(3)
    t = np.arange(1500) * 0.02
    z = 50.0 + 0.5 * rng.normal(size=len(t)) + np.where((t >= 10.0) & (t < 20.0), -6.0, 0.0)
    log = follow_magnitude(t, z, 0.25)
    (event,) = log.events
    assert event.found_s == pytest.approx(10.2)
    assert event.end_s == pytest.approx(20.0)
    assert event.shift_uT == pytest.approx(-6.0, abs=2.0)
    assert abs(log.predicted_uT[600] - 44.0) < 0.3
    assert abs(log.predicted_uT[-1] - 50.0) < 0.3


def test_a_field_that_stays_is_the_new_field_and_a_log_that_ends_leaves_its_event_open():
    t = np.arange(500) * 0.02
    z = np.where(t >= 2.0, 60.0, 50.0)
    (settled,) = follow_magnitude(t, z, 0.25, rule=OutlierRule(settles_after_s=3.0)).events
    assert not settled.returned
    assert settled.end_s == pytest.approx(5.02)
    (still_on,) = follow_magnitude(t, z, 0.25).events
    assert still_on.end_s is None


@given(st.floats(0.0, 100.0), st.floats(0.01, 10.0), st.floats(3.01, 50.0))
def test_adaptation_makes_the_innovation_one_sd_and_never_shrinks(P, R, sds):
    """P = y^2 - R, above 9 P + 8 R for an outlier (Brommer, L189-195, Eqs. 17-18)."""
    y = sds * np.sqrt(P + R)
    adapted = adapted_variance(P, y, R)
    assert adapted + R == pytest.approx(y * y)
    assert adapted > 9 * P + 8 * R - 1e-9


def test_adaptation_without_an_outlier_changes_nothing():
    assert adapted_variance(4.0, 0.1, 1.0) == 4.0


def test_an_undisturbed_log_has_the_nominal_rate_and_no_events():
    rng = np.random.default_rng(4)
    n = 60_000
    log = follow_magnitude(np.arange(n) * 0.02, 2466.0 + 20.0 * rng.normal(size=n), 400.0, reject=False)
    assert log.outlier.mean() == pytest.approx(CHANCE, abs=4 * np.sqrt(CHANCE / n))
    assert log.events == ()


@pytest.mark.parametrize("sds", [4.0, 4.5, 5.0])
def test_power_is_the_formulas(sds):
    """Phi(k - 3)^11: 0.15, 0.47, 0.78 (Brommer, by L175-197)."""
    assert detection_power(sds) == pytest.approx({4.0: 0.15, 4.5: 0.47, 5.0: 0.78}[sds], abs=0.005)
    rng = np.random.default_rng(5)
    hits = [found_at_once(rng.normal(size=11) + sds) for _ in range(1500)]
    assert np.mean(hits) == pytest.approx(float(detection_power(sds)), abs=0.05)


def found_at_once(z):
    return follow_magnitude(np.arange(len(z)) * 0.02, z, 1.0, start=(0.0, 1e-12)).found.any()


def test_a_random_walk_keeps_the_belief_alive():
    t = np.arange(3000) * 0.02
    drifting = 50.0 + 0.05 * t
    frozen = follow_magnitude(t, drifting, 0.25)
    alive = follow_magnitude(t, drifting, 0.25, drift_uT_per_s=0.1)
    assert abs(alive.predicted_uT[-1] - drifting[-1]) < 0.3 < abs(frozen.predicted_uT[-1] - drifting[-1])


@settings(max_examples=50)
@given(st.integers(0, 10_000))
def test_the_vector_statistic_is_that_of_whitened_residuals(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(4, 3, 3)) + 2 * np.eye(3)
    y = rng.normal(size=(4, 3))
    found = innovation_statistic(y, root @ np.swapaxes(root, 1, 2))
    np.testing.assert_allclose(
        found, [np.sum(np.linalg.solve(a, b) ** 2) for a, b in zip(root, y, strict=True)], rtol=1e-6
    )


def test_what_cannot_be_used_is_refused():
    with pytest.raises(InvalidInput, match="needed <= window"):
        OutlierRule(needed=5, window=3).check()
    with pytest.raises(InvalidInput, match="threshold"):
        OutlierRule(threshold=0.0).check()
    with pytest.raises(InvalidInput, match="two or more"):
        follow_magnitude(np.zeros(1), np.zeros(1), 1.0)
    with pytest.raises(InvalidInput, match="time 2 is before"):
        follow_magnitude(np.array([0.0, 2.0, 1.0]), np.zeros(3), 1.0)
    with pytest.raises(InvalidInput, match="reading 1 is not a number"):
        follow_magnitude(np.arange(3.0), np.array([1.0, np.nan, 1.0]), 1.0)
