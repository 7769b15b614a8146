"""Hard iron taken out of walks that know how the sensor was held, before the map is fitted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.field.fit import fit_map
from app.field.hard_iron import HardIron, remove_hard_iron
from app.field.spec import MapSpec

BIAS_UT = np.array([7.0, -4.0, 0.0])


def magnetised(walk, bias_uT, session):
    """The walk by a sensor that is turned along the path and has an offset in its own frame."""
    step = np.gradient(walk.p_building_m, axis=0)
    attitude = Rotation.from_rotvec(np.outer(np.arctan2(step[:, 1], step[:, 0]), [0.0, 0.0, 1.0]))
    q = attitude.as_quat(scalar_first=True)
    return replace(walk, B_uT=walk.B_uT + attitude.apply(bias_uT), q_body_to_building=q, session=session)


@pytest.fixture
def walks(room):
    return room.lanes(np.random.default_rng(1), surveys=3)


def rmse(fitted, room):
    x, y = np.meshgrid(np.arange(1.0, 11.0, 0.4), np.arange(1.0, 8.0, 0.4))
    p = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    return np.sqrt(np.mean(np.square(fitted.grid.at(p).mean_uT - room.field_uT(p))))


@pytest.mark.parametrize("session", [None, "morning"])
def test_the_map_of_a_magnetised_sensor_is_that_of_a_clean_one(room, walks, session):
    bad = {name: magnetised(walk, BIAS_UT, session) for name, walk in walks.items()}
    spec = MapSpec(resolution_m=0.5)
    with_it, without = (fit_map(bad, replace(spec, hard_iron=taken)) for taken in (False, True))
    assert rmse(without, room) < 0.5 * rmse(with_it, room)
    assert rmse(without, room) < 2.5 * rmse(fit_map(walks, spec), room)
    found = without.hard_iron["sessions" if session else "surveys"]
    for bias in found.values():
        assert np.allclose(bias["bias_body_ut"][:2], BIAS_UT[:2], atol=1.5)


def test_walks_of_unknown_attitude_are_left_alone(walks):
    cleaned = remove_hard_iron(walks, "vector", HardIron())
    assert all(cleaned.walks[name] is walk for name, walk in walks.items())
    assert not cleaned.offset_variance_uT2


def test_a_clean_sensor_is_left_alone(walks):
    clean = {name: magnetised(walk, np.zeros(3), None) for name, walk in walks.items()}
    cleaned = remove_hard_iron(clean, "vector", HardIron())
    assert all(cleaned.walks[name] is walk for name, walk in clean.items())


def test_what_is_known_is_kept_and_a_new_survey_changes_no_other(walks):
    bad = {name: magnetised(walk, BIAS_UT, "morning") for name, walk in walks.items()}
    few = {name: bad[name] for name in ("survey-0", "survey-1")}
    first = remove_hard_iron(few, "vector", HardIron())
    second = remove_hard_iron(bad, "vector", first.hard_iron)
    for name in few:
        assert np.array_equal(first.walks[name].B_uT, second.walks[name].B_uT)
    assert first.offset_variance_uT2.keys() < second.offset_variance_uT2.keys()
