"""How the benchmark of precise walks divides a walk, and what real walks say of their own sensor."""

import os
import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest

from app.field.body_bias import estimate_body_bias
from app.field.samples import Samples

ROOT = Path(__file__).parents[2]
REAL = Path(os.environ.get("ISODYN_TEST_DATA", "../shared/data")) / "kok-1d"


@pytest.fixture(scope="module")
def benchmark():
    spec = spec_from_file_location("kok_walks", ROOT / "benchmarks" / "kok_walks.py")
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look themselves up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def wandering(seed):
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, rng.uniform(4.0, 20.0), 400)
    p = np.column_stack([3.0 * np.cos(angle), 2.0 * np.sin(angle) + 0.05 * angle, np.zeros(400)])
    return Samples(np.arange(400.0), p + 0.02 * rng.normal(size=p.shape), np.zeros((400, 3)), "building")


@pytest.mark.parametrize("seed", range(4))
def test_first_visits_are_the_samples_without_an_earlier_one_nearby(benchmark, seed):
    walk = wandering(seed)
    mapped, asked = benchmark.first_visits(walk)
    path_m, p = walk.path_length_m(), walk.p_building_m[:, :2]
    for k in range(len(walk)):
        earlier = path_m[k] - path_m > benchmark.APART_M
        again = bool(np.any(np.linalg.norm(p[earlier] - p[k], axis=1) <= benchmark.NEAR_M))
        assert (mapped[k], asked[k]) == (not again, again)


@pytest.mark.parametrize("seed", range(4))
def test_halves_ask_what_comes_near_the_first_half_of_the_path(benchmark, seed):
    walk = wandering(seed)
    mapped, asked = benchmark.halves(walk)
    path_m, p = walk.path_length_m(), walk.p_building_m[:, :2]
    for k in range(len(walk)):
        first = path_m[k] < 0.5 * path_m[-1]
        near = np.linalg.norm(p[mapped] - p[k], axis=1).min() < benchmark.NEAR_M
        assert (mapped[k], asked[k]) == (first, not first and near)


@pytest.mark.real_data
@pytest.mark.skipif(not REAL.exists(), reason=f"no walks in {REAL}")
@pytest.mark.parametrize("name", ["square", "eight", "library", "mall"])
def test_both_halves_of_a_real_walk_have_the_same_bias(benchmark, name):
    """One sensor, one calibration: what the halves say apart agrees, though they were walked elsewhere."""
    walk = benchmark.read_walk(REAL / f"{name}.mat", benchmark.WALKS[name])
    later = np.arange(len(walk)) >= len(walk) // 2
    one, other = (estimate_body_bias(benchmark.chosen(walk, half)) for half in (~later, later))
    difference_uT = np.linalg.norm(one.bias_body_uT - other.bias_body_uT)
    assert difference_uT < 3.0 * np.sqrt(np.trace(one.covariance_uT2 + other.covariance_uT2))
    if name == "eight":
        assert 12.0 < np.linalg.norm(one.bias_body_uT) < 15.0
