"""GLM of a survey against the map of the others, by plain sums."""

from dataclasses import replace

import numpy as np
import pytest

from app.field.grid import FieldGrid
from app.field.leave_one_out import HeldOut
from app.field.samples import Samples
from app.field.spec import ConsistencyReport
from app.field.walk_localizability import add_localizability, gradient_along, walk_localizability


def made(seed: int = 0) -> tuple[Samples, HeldOut, FieldGrid]:
    """A straight walk through a field of slope (3, 4) uT/m, a quarter of it not judged, the map ending before it."""
    rng = np.random.default_rng(seed)
    n, cells = 200, np.zeros((1, 20, 40, 1), np.float32)
    slope = np.tile(np.array([3.0, 4.0], np.float32), (1, 20, 40, 1, 1))
    grid = FieldGrid("norm", (0.0, 0.0), 0.5, np.array([1.2]), cells, cells + 1, slope, np.ones((1, 20, 40), bool),
                     np.zeros(1), np.ones(1), np.ones(1))  # fmt: skip
    p = np.column_stack([np.linspace(0.0, 25.0, n), np.full(n, 4.0), np.full(n, 1.2)])
    samples = Samples(0.1 * np.arange(n), p, np.ones((n, 1)), "norm")
    error = rng.normal(0.0, 2.0, (n, 1))
    return samples, HeldOut(error, np.ones((n, 1)), np.arange(n) % 4 != 1, p[:, 0]), grid


def of(samples: Samples, held_out: HeldOut, grid: FieldGrid):
    report = ConsistencyReport("consistent", True, 100, 1.0)
    found = add_localizability({"s": report}, {"s": samples}, {"s": held_out}, grid)["s"]
    assert replace(found, localizability=None) == report
    return found.localizability


def test_it_is_of_the_judged_samples_on_the_map() -> None:
    samples, held_out, grid = made()
    told = of(samples, held_out, grid)
    assert told is not None
    seen = np.flatnonzero(held_out.judged & (samples.p_building_m[:, 0] <= 19.5))
    t_s = samples.t_s[seen]
    at = np.unique([seen[np.argmax(t_s >= t - 1e-9)] for t in np.arange(0.0, t_s[-1] + 1e-9, 0.5)])
    noise = np.abs(held_out.error_uT[:, 0])
    assert told.mean_signal_ut == pytest.approx(0.05 * 5.0)
    assert told.mean_noise_ut == pytest.approx(noise[at].mean())
    assert told.glm_average == pytest.approx(np.mean(0.25 / noise[at]))
    assert told.glm_ratio_of_means == pytest.approx(0.25 / noise[at].mean())
    moving = [0.25 / noise[seen[k - 4 : k + 1]].mean() for k in range(4, len(seen))]
    assert [told.glm_p5, told.glm_p50, told.glm_p95] == pytest.approx(np.percentile(moving, [5, 50, 95]).tolist())


def test_there_is_none_of_a_survey_that_nothing_judges() -> None:
    samples, held_out, grid = made()
    assert of(samples, replace(held_out, judged=np.arange(200) < 19), grid) is None
    assert of(samples, replace(held_out, judged=np.arange(200) < 20), grid) is not None
    assert of(samples, replace(held_out, judged=np.arange(200) >= 170), grid) is None


def test_a_ratio_to_no_noise_is_no_number() -> None:
    told = walk_localizability(0.1 * np.arange(30), np.ones(30), np.zeros((30, 1)))
    assert (told.glm_average, told.glm_ratio_of_means, told.glm_p50, told.mean_noise_ut) == (None, None, None, 0.0)


@pytest.mark.parametrize(("heights", "axes"), [(1, 2), (3, 2), (3, 3)])
def test_the_gradient_along_a_walk_is_that_of_the_map(heights: int, axes: int) -> None:
    rng = np.random.default_rng(heights + axes)
    shape = (heights, 12, 15, 3)
    mean = rng.normal(size=shape).astype(np.float32)
    slopes = rng.normal(size=(*shape, axes)).astype(np.float32)
    grid = FieldGrid("vector", (-1.0, 2.0), 0.5, np.array([0.5, 1.2, 2.5])[:heights], mean, mean + 9, slopes,
                     rng.random(shape[:3]) < 0.8, np.zeros(3), np.ones(3), np.ones(3))  # fmt: skip
    corners = np.array([[-1.0, 2.0, 0.5], [6.0, 7.5, 2.5], [-1.0, 7.5, 1.2], [0.5, 3.0, 1.2]])
    points = np.concatenate([rng.uniform([-2.0, 1.0, 0.0], [7.0, 8.5, 3.0], (3000, 3)), corners])
    values, found = grid.at(points), gradient_along(grid, points)
    np.testing.assert_array_equal(np.isfinite(found), values.measured)
    assert 200 < values.measured.sum() < 2200
    expected = np.linalg.norm(values.gradient_uT_per_m[values.measured], axis=(1, 2))
    np.testing.assert_allclose(found[values.measured], expected, rtol=1e-6)
