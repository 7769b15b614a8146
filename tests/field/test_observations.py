import numpy as np
import pytest

from app.field.observations import observe
from app.field.samples import Samples


@pytest.mark.parametrize("stretch_m", [0.05, 0.2, 0.5])
def test_stretches_are_those_of_the_plain_loop(stretch_m):
    rng = np.random.default_rng(0)
    position = np.cumsum(rng.normal(0.0, 0.05, (500, 3)), axis=0)
    starts = [0]
    for index, place in enumerate(position):
        if np.linalg.norm(place - position[starts[-1]]) >= stretch_m:
            starts.append(index)
    field = rng.normal(size=(500, 3))
    (walk,) = observe({"a": Samples(np.arange(500.0), position, field, "building")}, "vector", stretch_m)
    assert np.array_equal(np.unique(walk.stretch_of_sample, return_index=True)[1], starts)
    means = [part.mean(axis=0) for part in np.split(position, starts[1:])]
    assert np.allclose(walk.position_m, means)
