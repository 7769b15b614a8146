"""Coverage and conflict layers against a plain double loop over cells and surveys."""

import numpy as np
import pytest

from app.field.conflict import quality_layers
from app.field.leave_one_out import HeldOut
from app.field.observations import observe
from app.field.samples import Samples

GROUND = np.array([0.0])


def straight(name, start, stop, count=60, z_m=0.0):
    p = np.column_stack([np.linspace(start, stop, count), np.full(count, z_m)])
    samples = Samples(0.1 * np.arange(count), p, np.zeros((count, 3)), "building")
    return observe({name: samples}, "vector")[0]


def errors(walk, z, judged=True):
    n = len(walk.stretch_of_sample)
    z = np.broadcast_to(np.asarray(z, dtype=float), (n, 3)).copy()
    return HeldOut(2.0 * z, np.full((n, 3), 2.0), np.full(n, judged), walk.path_m[walk.stretch_of_sample])


def naive(x_m, y_m, walks, squared, slack_m):
    """Coverage and conflict with observations within a metre plus slack; squared: per walk, of each observation."""
    coverage, conflict = np.zeros((len(y_m), len(x_m))), np.full((len(y_m), len(x_m)), np.nan)
    for j, y in enumerate(y_m):
        for i, x in enumerate(x_m):
            near = [np.hypot(*(w.position_m[:, :2] - [x, y]).T) <= 1.0 + slack_m for w in walks]
            coverage[j, i] = sum(n.any() for n in near)
            means = [e[n].mean() for e, n in zip(squared, near, strict=True) if n.any()]
            if len(means) >= 2:
                conflict[j, i] = np.sqrt(np.mean(means))
    return coverage, conflict


@pytest.mark.parametrize("resolution_m", [0.1, 0.25, 0.5])
def test_layers_agree_with_a_plain_loop_to_half_a_cell(resolution_m):
    rng = np.random.default_rng(0)
    x, y = np.arange(-1.0, 9.0, resolution_m), np.arange(-1.0, 6.0, resolution_m)
    ends_m = rng.choice([0.0, 0.3, 4.0], (5, 2))
    walks = [straight(f"s{k}", [0.0, start], [8.0, stop]) for k, (start, stop) in enumerate(ends_m)]
    factors = {w.survey_id: rng.uniform(0.5, 3.0) for w in walks}
    held_out = {w.survey_id: errors(w, factors[w.survey_id]) for w in walks}
    layers = quality_layers(x, y, GROUND, walks, held_out)
    squared = [np.full(len(w), factors[w.survey_id] ** 2) for w in walks]
    half_m = max(resolution_m, 0.4) * np.sqrt(0.5)  # the observation in its cell; on 0.1 m, also the cell in its block
    fewest, _ = naive(x, y, walks, squared, -half_m)
    most, _ = naive(x, y, walks, squared, half_m)
    _, exact = naive(x, y, walks, squared, 0.0)
    coverage, conflict = layers["coverage"][0], layers["conflict"][0]
    assert coverage.dtype == conflict.dtype == np.float32
    assert np.all((fewest <= coverage) & (coverage <= most))
    assert coverage.max() >= 3
    clear = (fewest == most) & np.isfinite(exact)  # cells whose surveys do not depend on rounding
    assert clear.sum() >= 20
    assert np.allclose(conflict[clear], exact[clear], rtol=1e-5)
    assert np.isnan(conflict[most < 2]).all()


def test_a_survey_counts_once_however_many_samples_it_has():
    x, y = np.arange(0.0, 6.0, 0.5), np.array([0.0, 0.5])
    a, b = straight("a", [0.0, 0.0], [5.0, 0.0]), straight("b", [0.0, 0.2], [5.0, 0.2], count=6000)
    layers = quality_layers(x, y, GROUND, [a, b], {"a": errors(a, 3.0), "b": errors(b, 1.0)})
    assert np.all(layers["coverage"] == 2.0)
    assert np.allclose(layers["conflict"], np.sqrt((9.0 + 1.0) / 2.0))


def test_calibrated_surveys_conflict_by_about_one_and_a_moved_magnet_shows_where_it_is():
    rng = np.random.default_rng(1)
    x, y = np.arange(0.0, 20.0, 0.5), np.arange(0.0, 1.0, 0.5)
    walks = [straight(f"s{k}", [0.0, 0.1 * k], [20.0, 0.1 * k], count=100) for k in range(8)]
    held_out = {w.survey_id: errors(w, rng.normal(size=(100, 3))) for w in walks}
    calm = quality_layers(x, y, GROUND, walks, held_out)["conflict"]
    assert np.mean(calm**2) == pytest.approx(1.0, abs=0.1)
    held_out["s7"].error_uT[60:70] += 20.0  # 12 to 14 m
    moved = quality_layers(x, y, GROUND, walks, held_out)["conflict"]
    assert x[np.argmax(moved[0, 0])] == pytest.approx(13.0, abs=1.0)
    assert moved.max() > 2.0
    far = (x < 10.5) | (x > 15.5)
    assert np.array_equal(moved[..., far], calm[..., far])


def test_a_single_or_unjudged_survey_has_coverage_but_no_conflict():
    x, y = np.arange(0.0, 6.0, 0.5), np.array([0.0])
    a, b = straight("a", [0.0, 0.0], [5.0, 0.0]), straight("b", [0.0, 0.5], [5.0, 0.5])
    layers = quality_layers(x, y, GROUND, [a, b], {"a": errors(a, 1.0), "b": errors(b, 1.0, judged=False)})
    assert np.all(layers["coverage"] == 2.0)
    assert np.isnan(layers["conflict"]).all()


def test_heights_see_the_surveys_near_them():
    x, y = np.arange(0.0, 6.0, 0.5), np.array([0.0])
    low, high = straight("low", [0.0, 0.0], [5.0, 0.0], z_m=0.5), straight("high", [0.0, 0.0], [5.0, 0.0], z_m=2.0)
    held_out = {"low": errors(low, 1.0), "high": errors(high, 2.0)}
    layers = quality_layers(x, y, np.array([0.0, 1.3, 2.0, 9.0]), [low, high], held_out)
    assert layers["coverage"].shape == layers["conflict"].shape == (4, 1, len(x))
    assert layers["coverage"][:, 0, 5].tolist() == [1.0, 2.0, 1.0, 0.0]
    assert np.isfinite(layers["conflict"][:, 0, 5]).tolist() == [False, True, False, False]
    one = quality_layers(x, y, np.array([9.0]), [low, high], held_out)  # a map of one height serves every height
    assert np.all(one["coverage"] == 2.0)
