"""The study of Shockley's orderings in small: it finds places, and its verdicts say what they should."""

import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def study_of():
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield import_module("shockley_orderings")
    finally:
        sys.path.remove(str(BENCHMARKS))
        for name in [name for name in sys.modules if name.split(".")[0] in ("shockley", "shockley_orderings")]:
            del sys.modules[name]


@pytest.fixture(scope="module")
def small(study_of):
    return study_of.Study((1, 2), 30)


def test_a_vehicle_finds_itself_on_its_own_map(study_of, small):
    case = study_of.Case("TT", samples=4)
    for seed in small.worlds:
        errors = small.errors_m(case, seed)
        assert np.isfinite(errors["ML"]).all()
        for technique in ("ML", "MLR", "ABL"):
            fixed = errors[technique][np.isfinite(errors[technique])]
            assert np.mean(fixed < 10.0) > 0.5
        assert np.isnan(errors["MLR"]).any()


@pytest.mark.parametrize("group", ["of_single_epochs", "of_sections", "of_anomalies"])
def test_every_ordering_of_the_rectangle_is_computed(study_of, small, group):
    checks = getattr(study_of, group)(small)
    assert all(part.label for check in checks for part in check.parts)
    accuracy_of_all = [p for c in checks for p in c.parts if p.label.split()[-1] == "ML"]
    assert all(part.verdict != "NOT COMPUTED" for part in accuracy_of_all)
    assert len(study_of.figures(small)) > 5


def test_other_vehicles_are_worse(study_of, small):
    check = next(c for c in study_of.of_single_epochs(small) if c.claim.startswith("other vehicle much worse"))
    assert check.parts[0].points > 10.0


def test_verdicts(study_of):
    part, check = study_of.Part, study_of.Check
    above, below, within = study_of.above, study_of.below, study_of.within

    def verdict(rule, points, error):
        return part("x", points, error, rule).verdict

    assert verdict(above(), 3.0, 1.0) == "AGREES"
    assert verdict(above(), 1.0, 1.0) == "UNDECIDED"
    assert verdict(above(), -3.0, 1.0) == "DISAGREES"
    assert verdict(above(10.0), 11.0, 1.0) == "UNDECIDED"
    assert verdict(below(5.0), 1.0, 1.0) == "AGREES"
    assert verdict(below(5.0), 9.0, 1.0) == "DISAGREES"
    assert verdict(within(10.0), -3.0, 1.0) == "AGREES"
    assert verdict(within(10.0), -15.0, 1.0) == "DISAGREES"
    assert verdict(above(), np.nan, 1.0) == "NOT COMPUTED"
    up, down = part("up", 3.0, 1.0, above()), part("down", -3.0, 1.0, above())
    assert check("c", "L1", [up, up]).verdict == "AGREES"
    assert check("c", "L1", [up, down]).verdict == "DISAGREES"
    assert check("c", "L1", [up, down], exceptions=1).verdict == "AGREES"


def test_standard_error_of_equal_worlds_is_that_of_their_mean(study_of):
    worlds = 200
    study = study_of.Study(tuple(range(worlds)), 25)
    rng, case = np.random.default_rng(0), study_of.Case("TT")
    for seed in study.worlds:
        study.found[case, seed] = {"ML": np.where(rng.random(25) < 0.3, 1.0, 99.0), "MLR": np.full(25, np.nan)}
    points, error = study_of.contrast(study, (1, study_of.Side("ML", (case,))))
    assert points == pytest.approx(30.0, abs=3.0)
    assert error == pytest.approx(100.0 * np.sqrt(0.3 * 0.7 / (25 * worlds)), rel=0.15)
    assert np.isnan(study_of.contrast(study, (1, study_of.Side("MLR", (case,))))[0])
