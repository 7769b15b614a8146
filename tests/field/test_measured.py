import numpy as np
import pytest
from scipy.spatial import cKDTree

from app.field.measured import near_other_walks
from app.field.observations import observe
from app.field.samples import Samples
from app.field.tiles import REACH_M


@pytest.mark.parametrize("volume", [False, True])
def test_near_another_walk_as_a_search_for_the_nearest_neighbour_finds(volume):
    rng = np.random.default_rng(0)
    walks = {}
    for name in "abcd":
        p = np.cumsum(rng.normal(0.0, 0.3, (300, 3)), axis=0) + rng.uniform(-6.0, 6.0, 3)
        walks[name] = Samples(np.arange(300.0), p, rng.normal(size=(300, 3)), "building")
    observed = observe(walks, "vector")
    axes = 3 if volume else 2
    near = near_other_walks(observed, volume)
    for walk in observed:
        others = np.concatenate([other.position_m[:, :axes] for other in observed if other is not walk])
        distance_m, _ = cKDTree(others).query(walk.position_m[:, :axes])
        assert np.array_equal(near[walk.survey_id], (distance_m <= REACH_M)[walk.stretch_of_sample])
    assert 0.05 < np.mean(np.concatenate(list(near.values()))) < 0.95
