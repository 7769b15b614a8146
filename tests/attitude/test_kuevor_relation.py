"""Table 3.5's relation in one room: the map at least halves what one point of it leaves (Kuevor, R12, L227)."""

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from app.synthetic.room import make_room

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "kuevor_attitude.py"


def _benchmark(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr("sys.argv", [str(BENCHMARK)])
    spec = importlib.util.spec_from_file_location("kuevor_attitude", BENCHMARK)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_a_map_halves_roll_pitch_and_yaw(monkeypatch: pytest.MonkeyPatch) -> None:
    benchmark = _benchmark(monkeypatch)
    rmse = benchmark.table(make_room(np.random.default_rng(1)), 1, ours=False, seconds=60.0).mean(axis=0)
    by_name = dict(zip(benchmark.REFERENCES, rmse, strict=True))
    ratio = by_name["one point"] / by_name["map"]
    assert np.all(ratio >= [2.0, 2.0, 1.8]), ratio  # flights half as long as the benchmark's, where yaw is halved too
    assert by_name["none"][0] > 2.0 * by_name["map"][0]
    fast = dict(
        zip(benchmark.REFERENCES, benchmark.table(make_room(np.random.default_rng(2)), 2, True, 60.0)[2], strict=True)
    )
    assert np.all(fast["none"][:2] < 1.0)  # ours needs no magnetometer to see that a turn is not a tilt
