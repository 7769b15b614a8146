"""Benchmarks are scripts that import each other by their file names."""

import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from app.positioning.locate import prepare_floors
from app.synthetic.building import make_building

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="session")
def benchmark_named() -> Iterator[Callable[[str], ModuleType]]:
    """The script of that name as a module."""
    known = set(sys.modules)
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield import_module
    finally:
        sys.path.remove(str(BENCHMARKS))
        for name in set(sys.modules) - known:
            if str(getattr(sys.modules[name], "__file__", "")).startswith(str(BENCHMARKS)):
                del sys.modules[name]


@pytest.fixture(scope="session")
def small_building(benchmark_named):
    """A building of one floor of 14 x 12 m, and its surveyed map, ready to be searched."""
    rng = np.random.default_rng(3)
    building = make_building(rng, width_m=14.0, depth_m=12.0, floors=1)
    return building, prepare_floors({"0": benchmark_named("calibration").surveyed_map(building, 0, rng)})
