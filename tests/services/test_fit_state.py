from dataclasses import replace

import numpy as np
import pytest

from app.errors import CorruptArtefact
from app.field.fit import fit_map
from app.field.samples import Samples
from app.field.spec import MapSpec
from app.services import fit_state
from app.services.fit_state import state_from_bytes, state_to_bytes


def walk(seed, y_m):
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, 8.0, 0.2)
    p = np.column_stack([x, np.full(len(x), y_m), np.full(len(x), 1.2)])
    B = np.column_stack([20 + 4 * np.sin(x), 3 * np.cos(0.7 * x + y_m), np.full(len(x), -40.0)])
    return Samples(0.2 * np.arange(len(x)), p, B + 0.2 * rng.normal(size=B.shape), "building")


WALKS = {f"s{k}": walk(k, 0.4 * k) for k in range(5)}


@pytest.mark.parametrize(
    "spec",
    [
        MapSpec(resolution_m=0.5),
        MapSpec(resolution_m=0.5, curl_free=True, noise="white"),
        MapSpec(resolution_m=0.5, kernel="matern52+matern52", components="norm", noise="white"),
    ],
)
def test_a_fit_continues_from_bytes_as_from_memory(spec):
    state = fit_map(WALKS, spec).state
    more = WALKS | {"far": replace(walk(9, 1.0), p_building_m=np.add(walk(9, 1.0).p_building_m, [0.0, 9.0, 0.0]))}
    data = state_to_bytes(state, {})
    assert state_to_bytes(state_from_bytes(data, {}), {}) == data
    from_bytes, from_memory, anew = (
        fit_map(more, spec, previous=s) for s in (state_from_bytes(data, {}), state, replace(state, tiles={}))
    )
    assert from_bytes.tiles_refitted == from_memory.tiles_refitted < anew.tiles_refitted
    for name in ("mean_uT", "sd_uT", "gradient_uT_per_m", "noise_sd_uT"):
        assert np.array_equal(getattr(from_bytes.grid, name), getattr(anew.grid, name)), name
        assert np.array_equal(getattr(from_memory.grid, name), getattr(anew.grid, name)), name
    assert from_bytes.score == anew.score


def test_the_state_of_another_version_is_not_read(monkeypatch):
    data = state_to_bytes(fit_map(WALKS, MapSpec(resolution_m=0.5)).state, {})
    monkeypatch.setattr(fit_state, "_VERSION", "another")
    with pytest.raises(CorruptArtefact, match="version"):
        state_from_bytes(data, {})


def test_a_state_of_other_stretches_is_not_continued() -> None:
    """A survey's part in the fit is only worth keeping as long as the same samples of it count."""
    state = fit_map(WALKS, MapSpec(resolution_m=0.5)).state
    name = min(WALKS)
    data = state_to_bytes(state, {name: [[1.0, 2.0]]})
    assert state_from_bytes(data, {name: [[1.0, 2.0]], "newcomer": [[0.0, 1.0]]}).tiles.keys() == state.tiles.keys()
    for other in ({}, {name: [[1.0, 3.0]]}):
        with pytest.raises(CorruptArtefact, match=name):
            state_from_bytes(data, other)
