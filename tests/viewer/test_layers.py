"""Layers as numbers, colours and legends."""

from types import SimpleNamespace

import numpy as np
import pytest

from app.errors import InvalidInput
from app.field.samples import COMPONENT_NAMES
from app.viewer.layers import (
    LAYERS,
    ColourScale,
    colour_scale,
    difference_uT,
    layer_names,
    layer_values,
    nearest_height,
)
from app.viewer.legends import legend


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
def test_every_layer_of_a_map_leaves_unmeasured_cells_out(grid_of, components):
    grid = grid_of(components, heights=2)
    names = layer_names(components)
    assert set(COMPONENT_NAMES[components]) < set(names)
    assert set(names) <= set(LAYERS)
    for layer in names:
        values = layer_values(grid, layer, 1)
        assert values.shape == grid.measured.shape[1:]
        if layer == "expected_error":  # at the rim no window may end
            assert not (np.isfinite(values) & ~grid.measured[1]).any()
            assert np.isfinite(values).sum() > 0.98 * grid.measured[1].sum()
        elif layer != "measured":
            np.testing.assert_array_equal(np.isfinite(values), grid.measured[1])


def test_stored_layers_are_those_of_the_map_where_it_was_measured(grid_of):
    grid = grid_of("level", heights=2)
    coverage = np.arange(grid.measured.size, dtype=np.float32).reshape(grid.measured.shape)
    assert "coverage" in layer_names("level", {"coverage": coverage})
    values = layer_values(grid, "coverage", 1, {"coverage": coverage})
    np.testing.assert_array_equal(values[grid.measured[1]], coverage[1][grid.measured[1]])
    assert np.isnan(values[~grid.measured[1]]).all()
    with pytest.raises(InvalidInput, match=r"no layer 'conflict' \(maps built again have it\).* coverage, meas"):
        layer_values(grid, "conflict", 1, {"coverage": coverage})


def test_the_nearest_height_is_taken(grid_of):
    grid = grid_of(heights=3)  # 1.2, 1.7 and 2.2 m
    assert [nearest_height(grid, z) for z in (None, 0.75, 1.44, 1.46, 1.96, 2.65)] == [0, 0, 0, 1, 2, 2]
    for far_m in (-9.0, 0.65, 2.75, 50.0):
        with pytest.raises(InvalidInput, match=r"1\.20, 1\.70, 2\.20 m"):
            nearest_height(grid, far_m)


def test_the_gradient_along_the_floor_leaves_the_vertical_out(grid_of):
    grid = grid_of()
    upward = np.full((*grid.gradient_uT_per_m.shape[:-1], 1), 9.0, np.float32)
    both = SimpleNamespace(
        components="vector", heights_m=grid.heights_m, measured=grid.measured,
        gradient_uT_per_m=np.concatenate([grid.gradient_uT_per_m, upward], axis=-1),
    )  # fmt: skip
    np.testing.assert_array_equal(layer_values(both, "gradient"), layer_values(grid, "gradient"))


def test_norm_agrees_across_components(grid_of):
    vector, level, norm = (layer_values(grid_of(c), "norm") for c in ("vector", "level", "norm"))
    np.testing.assert_allclose(level, vector, rtol=1e-5)
    np.testing.assert_allclose(norm, vector, rtol=1e-5)


def test_components_sd_and_gradient_are_the_grids_own(grid_of):
    grid = grid_of("vector")
    j, i = np.argwhere(grid.measured[0])[123]
    assert layer_values(grid, "by")[j, i] == grid.mean_uT[0, j, i, 1]
    assert layer_values(grid, "sd")[j, i] == pytest.approx(np.sqrt(3.0) * grid.sd_uT[0, j, i, 0], rel=1e-6)
    assert layer_values(grid, "gradient")[j, i] == pytest.approx(np.linalg.norm(grid.gradient_uT_per_m[0, j, i]))
    np.testing.assert_array_equal(layer_values(grid, "measured"), grid.measured[0])


def test_gradients_along_the_axes_make_up_the_whole_and_noise_takes_information(grid_of):
    grid = grid_of("vector")
    along_x, along_y, whole = (layer_values(grid, name) for name in ("gradient_x", "gradient_y", "gradient"))
    np.testing.assert_allclose(np.hypot(along_x, along_y), whole, rtol=1e-6)
    j, i = np.argwhere(grid.measured[0])[123]
    assert along_x[j, i] == pytest.approx(np.linalg.norm(grid.gradient_uT_per_m[0, j, i, :, 0]))
    variance = grid.sd_uT[0, j, i, 0] ** 2 + 0.5**2 + 0.5**2
    assert layer_values(grid, "information")[j, i] == pytest.approx(whole[j, i] ** 2 / variance, rel=1e-5)


def test_an_unknown_layer_or_height_is_refused_with_what_there_is(grid_of):
    with pytest.raises(InvalidInput, match="level map has no layer 'bx'; ask for one of norm, horizontal, vertical"):
        layer_values(grid_of("level"), "bx")
    with pytest.raises(InvalidInput, match=r"0: 1\.20 m, 1: 1\.70 m"):
        layer_values(grid_of(heights=2), "norm", 2)


def test_scales_cover_the_values_of_every_floor_and_survive_none_and_one():
    scale = colour_scale("norm", [np.linspace(10.0, 20.0, 1001), np.array([np.nan, 30.0] * 500)])
    assert 10.0 <= scale.low < 11.0
    assert scale.high == 30.0
    for values in ([], [np.full(5, np.nan)], [np.full(5, 7.0)]):
        scale = colour_scale("norm", values)
        assert scale.high > scale.low


def test_the_scale_of_conflict_shows_agreement_as_calm_and_conflict_in_full():
    calm, torn = (colour_scale("conflict", [np.full(9, value)]) for value in (0.9, 7.0))
    assert (calm.low, calm.high) == (0.0, 2.0)
    assert (torn.low, torn.high) == (0.0, 7.0)


def test_colours_are_monotone_in_lightness():
    """So that the picture can be read without telling hues apart."""
    for name in sorted({layer.colour_map for layer in LAYERS.values()}):
        rgb = ColourScale(0.0, 1.0, name).rgb(np.linspace(0.0, 1.0, 64)) / 255.0
        linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
        luminance = linear @ [0.2126, 0.7152, 0.0722]
        assert (np.diff(luminance) > -2e-3).all()
    np.testing.assert_array_equal(
        ColourScale(2.0, 4.0).rgb(np.array([-9.0, 9.0, np.nan])), ColourScale(2.0, 4.0).rgb(np.array([2.0, 4.0, 2.0]))
    )


def test_a_legend_says_name_unit_and_range_in_words():
    told = legend("Gradient along the floor", "µT/m", ColourScale(0.25, 12.0))
    assert (told.title, told.unit) == ("Gradient along the floor", "µT/m")
    assert told.ticks == ["0.2", "3.2", "6.1", "9.1", "12.0"]
    assert told.colours[0] == "rgb(68,1,84)"  # viridis
    assert told.colours[-1] == "rgb(253,231,36)"


def test_the_inclination_is_the_dip_of_the_mean_field(grid_of):
    grid = grid_of()
    dip = layer_values(grid, "inclination")
    j, i = np.argwhere(grid.measured[0])[100]
    bx, by, bz = grid.mean_uT[0, j, i]
    assert dip[j, i] == pytest.approx(np.degrees(np.arctan2(-bz, np.hypot(bx, by))))
    assert dip[j, i] > 0  # in the north the field dips down
    np.testing.assert_allclose(layer_values(grid_of("level"), "inclination"), dip, atol=1e-4)
    assert "inclination" not in layer_names("norm")


def test_the_difference_of_two_maps_is_that_of_their_fields_where_both_were_measured(grid_of):
    grid, other = grid_of(), grid_of(seed=4, origin_m=(102.0, 41.0))
    difference = difference_uT(grid, other)[0]
    j, i = 20, 30
    x, y = 100.0 + 0.25 * i, 40.0 + 0.25 * j
    there = other.at(np.array([[x, y, 1.2]]))
    assert there.measured[0]
    assert difference[j, i] == pytest.approx(np.linalg.norm(grid.mean_uT[0, j, i] - there.mean_uT[0]), rel=1e-5)
    assert np.isnan(difference[0, 0])  # beside the other map
    assert np.nanmax(difference_uT(grid, grid)) == 0.0
    norms = difference_uT(grid, grid_of("norm"))
    assert np.nanmax(norms) < 1e-3
