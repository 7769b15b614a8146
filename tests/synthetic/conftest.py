import numpy as np
import pytest

from app.synthetic import SyntheticBuilding, make_building


@pytest.fixture(scope="session")
def building() -> SyntheticBuilding:
    return make_building(np.random.default_rng(7), width_m=20.0, depth_m=16.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20261)
