"""Grids and samples as bytes: what goes in comes out, the same values give the same bytes, damage is noticed."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import CorruptArtefact
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components, Samples
from app.services.artefacts import (
    grid_from_bytes,
    grid_to_bytes,
    layers_from_bytes,
    layers_to_bytes,
    samples_from_bytes,
    samples_to_bytes,
)


def make_grid(components: Components, seed: int = 0) -> FieldGrid:
    rng = np.random.default_rng(seed)
    c = len(COMPONENT_NAMES[components])
    shape = (1, 5, 7, c)
    return FieldGrid(
        components=components,
        origin_m=(-1.0, 2.0),
        resolution_m=0.25,
        heights_m=np.array([1.2]),
        mean_uT=rng.normal(size=shape).astype(np.float32),
        sd_uT=rng.uniform(0.1, 1, shape).astype(np.float32),
        gradient_uT_per_m=rng.normal(size=(*shape, 2)).astype(np.float32),
        measured=rng.uniform(size=shape[:3]) > 0.3,
        ambient_uT=rng.normal(size=c),
        prior_sd_uT=np.full(c, 5.0),
        noise_sd_uT=np.full(c, 0.4),
        error_correlation_m=1.5,
    )


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
def test_a_grid_comes_back_as_it_was(components: Components) -> None:
    grid = make_grid(components)
    data = grid_to_bytes(grid)
    assert data == grid_to_bytes(make_grid(components)), "the hash is the map's identity"
    back = grid_from_bytes(data)
    for field in fields(FieldGrid):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(grid, field.name))


def test_layers_come_back_as_they_were_whatever_their_order() -> None:
    rng = np.random.default_rng(2)
    layers = {name: rng.normal(size=(2, 5, 7)).astype(np.float32) for name in ("coverage", "conflict")}
    layers["conflict"][0, :2] = np.nan
    data = layers_to_bytes(layers)
    assert data == layers_to_bytes(dict(reversed(layers.items())))
    assert data == layers_to_bytes({name: layer.astype(np.float64) for name, layer in layers.items()})
    back = layers_from_bytes(data)
    assert list(back) == ["conflict", "coverage"]
    for name, layer in layers.items():
        assert back[name].dtype == np.float32
        np.testing.assert_array_equal(back[name], layer)


@pytest.mark.parametrize("frame", ["building", "level", "norm"])
@pytest.mark.parametrize("full", [True, False])
def test_samples_come_back_as_they_were(frame: str, full: bool) -> None:
    rng = np.random.default_rng(1)
    samples = Samples(
        t_s=np.arange(4.0),
        p_building_m=rng.normal(size=(4, 3)),
        B_uT=rng.normal(size=(4, 1 if frame == "norm" else 3)),
        frame=frame,  # type: ignore[arg-type]
        q_body_to_building=np.tile([1.0, 0, 0, 0], (4, 1)) if full else None,
        session="s1" if full else None,
    )
    back = samples_from_bytes(samples_to_bytes(samples))
    for field in fields(Samples):
        np.testing.assert_array_equal(getattr(back, field.name), getattr(samples, field.name))


@given(st.binary(max_size=200))
def test_bytes_that_are_no_artefact_are_named_damaged(data: bytes) -> None:
    with pytest.raises(CorruptArtefact):
        grid_from_bytes(data)


def test_one_kind_is_not_taken_for_another() -> None:
    with pytest.raises(CorruptArtefact, match="samples was expected"):
        samples_from_bytes(grid_to_bytes(make_grid("norm")))
    with pytest.raises(CorruptArtefact, match="layers was expected"):
        layers_from_bytes(grid_to_bytes(make_grid("norm")))


def test_a_truncated_grid_is_damaged() -> None:
    with pytest.raises(CorruptArtefact):
        grid_from_bytes(grid_to_bytes(make_grid("vector"))[:-10])
