"""Adding, leaving out, deleting and replacing a survey: only its tiles are fitted again, and no bit tells."""

from dataclasses import replace

import numpy as np
import pytest

from app.field.fit import fit_map
from app.field.spec import MapSpec

SPECS = {
    "plane": MapSpec(resolution_m=0.5),
    "two lengths": MapSpec(resolution_m=0.5, kernel="matern32+matern32", components="level"),
    "robust": MapSpec(resolution_m=0.5, robust=True, components="norm"),
    "potential": MapSpec(resolution_m=0.5, curl_free=True, noise="white"),
}


def same_map(one, other):
    names = ("mean_uT", "sd_uT", "gradient_uT_per_m", "measured", "noise_sd_uT", "ambient_uT", "prior_sd_uT")
    assert all(np.array_equal(getattr(one.grid, name), getattr(other.grid, name)) for name in names)
    assert one.grid.origin_m == other.grid.origin_m
    assert one.hyperparameters == other.hyperparameters
    assert one.score == other.score
    assert one.consistency == other.consistency


def refit(walks, spec, state):
    """A fit of everything with what the state has learned."""
    return fit_map(walks, spec, previous=replace(state, tiles={}))


@pytest.mark.parametrize("name", SPECS)
def test_a_map_does_not_tell_how_it_came_about(make_room, name):
    room, spec = make_room(11), SPECS[name]
    rng = np.random.default_rng(1)
    walks = room.lanes(rng, surveys=3, lane_m=2.0)
    extra = room.walk(rng, np.array([[1.0, 1.0], [3.0, 1.5], [3.0, 2.5]]))
    first = fit_map(walks, spec)
    state = first.state
    assert first.tiles_refitted == len(state.tiles)

    added = fit_map(walks | {"extra": extra}, spec, previous=state)
    assert 0 < added.tiles_refitted < len(added.state.tiles)
    same_map(added, refit(walks | {"extra": extra}, spec, state))

    again = fit_map(walks, spec, previous=added.state)
    assert again.tiles_refitted == added.tiles_refitted
    same_map(again, first)

    moved = replace(extra, B_uT=extra.B_uT + 0.5)
    replaced = fit_map(walks | {"extra-2": moved}, spec, previous=added.state)
    same_map(replaced, refit(walks | {"extra-2": moved}, spec, state))

    unchanged = fit_map(walks, spec, previous=state)
    assert unchanged.tiles_refitted == 0
    same_map(unchanged, first)


def test_much_more_data_is_learned_from_anew(room):
    walks = room.lanes(np.random.default_rng(1), surveys=4)
    few = {"survey-0": walks["survey-0"]}
    state = fit_map(few, SPECS["plane"]).state
    same_map(fit_map(walks, SPECS["plane"], previous=state), fit_map(walks, SPECS["plane"]))


def test_another_height_or_another_range_of_heights_is_fitted_anew(room):
    walks = room.lanes(np.random.default_rng(1), surveys=2, lane_m=2.0)
    spec = replace(SPECS["potential"], heights_m=(0.0,))
    state = fit_map(walks, spec).state
    higher = replace(spec, heights_m=(0.0, 1.0))
    same_map(fit_map(walks, higher, previous=state), fit_map(walks, higher))
