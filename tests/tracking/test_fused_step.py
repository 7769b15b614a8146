"""The compiled step and its random numbers against plain numpy."""

import numpy as np
import pytest
from scipy.stats import kstest

from app.field.grid import FieldGrid
from app.tracking.cloud import Cloud, Step, cell_table
from app.tracking.field_likelihood import log_likelihood, neutral, turned
from app.tracking.field_lookup import look_up_plain
from app.tracking.fused_step import step_fused
from app.tracking.motion import Displacement
from app.tracking.particle_filter import normalise
from app.tracking.plain_step import step_plain
from app.tracking.random_numbers import BLOCK, exp_of, log_of, normals, philox, uniform

STEP = Step((0.4, 0.1), (18.0, 2.0, -44.0), 0.5, Displacement(0.1, 0.05, 0.01))


@pytest.fixture(scope="module")
def grid() -> FieldGrid:
    rng = np.random.default_rng(1)
    y, x = np.mgrid[0:40, 0:60] * 0.25
    mean = np.stack([18.0 + 3.0 * np.sin(x), 2.0 + 4.0 * np.cos(x + y), -44.0 + 2.0 * np.sin(y)], axis=-1)[None]
    sd = np.repeat(rng.uniform(0.2, 1.0, (1, 40, 60, 1)), 3, axis=3)
    return FieldGrid(
        components="vector",
        origin_m=(-2.0, 1.0),
        resolution_m=0.25,
        heights_m=np.zeros(1),
        mean_uT=mean.astype(np.float32),
        sd_uT=sd.astype(np.float32),
        gradient_uT_per_m=np.zeros((*mean.shape, 2), dtype=np.float32),
        measured=rng.random((1, 40, 60)) > 0.05,
        ambient_uT=np.array([18.0, 2.0, -44.0]),
        prior_sd_uT=np.full(3, 5.0),
        noise_sd_uT=np.ones(3),
    )


def cloud_of(n: int, spread_m: float = 2.0, seed: int = 2) -> Cloud:
    rng = np.random.default_rng(seed)
    return Cloud.of(rng.normal([5.0, 6.0], spread_m, (n, 2)), rng.normal(0.0, 0.3, n), rng.normal(1.0, 0.05, n))


def uniform_of(number: int, seed: int) -> float:
    return float(uniform(np.uint64(number), np.uint64(seed)))


class TestRandomNumbers:
    @pytest.mark.parametrize(
        ("rounds", "words"),
        [
            (7, (0x5F6FB709, 0x0D893F64, 0x4F121F81, 0x4F730A48)),
            (10, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ],
    )
    def test_known_answers(self, rounds, words):
        """Counter and key zero, from the vectors of the authors' library (Random123)."""
        counter = np.zeros((4, 3), dtype=np.uint32)
        philox(counter, np.uint64(0), np.uint64(0), rounds)
        np.testing.assert_array_equal(counter, np.tile(words, (3, 1)).T)

    def test_normal(self):
        z = normals(100_000, 5, 99).astype(np.float64)
        assert all(kstest(row, "norm").pvalue > 1e-3 for row in z)
        assert np.abs(np.corrcoef(z) - np.eye(4)).max() < 0.02
        assert np.mean(z**4) == pytest.approx(3.0, abs=0.1)
        assert 4.0 < np.abs(z).max() < 6.7

    def test_steps_and_seeds_differ(self):
        first = normals(1000, 1, 1)
        for other in (
            normals(1000, 2, 1),
            normals(1000, 1, 2),
            normals(1000, 1 + 2**32, 1),
            normals(1000, 1, 1 + 2**32),
        ):
            assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.08

    def test_a_particles_numbers_do_not_depend_on_how_many_there_are(self):
        np.testing.assert_array_equal(normals(50, 3, 4), normals(900, 3, 4)[:, :50])

    def test_uniform(self):
        drawn = np.array([uniform_of(k, 3) for k in range(2000)])
        assert kstest(drawn, "uniform").pvalue > 1e-3

    def test_polynomials(self):
        x = np.geomspace(1e-9, 1e9, 500).astype(np.float32)
        np.testing.assert_allclose([log_of(v) for v in x], np.log(x.astype(np.float64)), rtol=3e-7, atol=1e-7)
        y = -np.linspace(0.0, 86.0, 500).astype(np.float32)
        np.testing.assert_allclose([exp_of(v) for v in y], np.exp(y.astype(np.float64)), rtol=3e-7)


@pytest.mark.parametrize("n", [7, BLOCK, 2500])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_fused_is_plain_with_the_same_random_numbers(grid, n, dtype):
    table, cloud, resampled = cell_table(grid), cloud_of(n), 0
    for number in range(4):
        fused = step_fused(cloud, table, STEP, number, 7)
        wide = Cloud(cloud.state.astype(dtype), cloud.weight.astype(dtype))
        plain = step_plain(wide, table, STEP, normals(n, number, 7).astype(dtype), uniform_of(number, 7))
        assert fused.resampled == plain.resampled
        np.testing.assert_allclose(fused.cloud.state, plain.cloud.state, rtol=2e-5, atol=2e-5)
        np.testing.assert_allclose(n * fused.cloud.weight, n * plain.cloud.weight, rtol=5e-3, atol=1e-4)
        assert fused.effective == pytest.approx(plain.effective, rel=1e-3)
        np.testing.assert_allclose(fused.moments.mean, plain.moments.mean, atol=1e-4)
        np.testing.assert_allclose(fused.moments.covariance_m2, plain.moments.covariance_m2, atol=1e-3)
        cloud, resampled = fused.cloud, resampled + fused.resampled
    assert resampled


def test_weights_are_those_of_the_general_likelihood(grid):
    cloud = cloud_of(400)
    stepped = step_fused(cloud, cell_table(grid), STEP, 0, 1)
    x, y, c, s, _ = stepped.cloud.state.astype(np.float64)
    looked = look_up_plain(grid, np.column_stack([x, y]))
    log_l = log_likelihood(looked, turned(np.array(STEP.reading_uT), np.arctan2(s, c)), STEP.sensor_variance_uT2)
    expected = normalise(neutral(log_l, looked.measured, np.zeros(400))).weight
    np.testing.assert_allclose(400 * stepped.cloud.weight, 400 * expected, rtol=1e-2, atol=1e-3)
    assert not looked.measured.all()


def test_same_seed_and_step_give_the_same_bits(grid):
    table, cloud = cell_table(grid), cloud_of(1000)
    first, again = (step_fused(cloud, table, STEP, 11, 5).cloud for _ in range(2))
    assert first.state.tobytes() == again.state.tobytes()
    assert first.weight.tobytes() == again.weight.tobytes()
    assert step_fused(cloud, table, STEP, 12, 5).cloud.state.tobytes() != first.state.tobytes()


def test_heading_stays_a_direction(grid):
    table, cloud = cell_table(grid), cloud_of(500)
    for number in range(300):
        cloud = step_fused(cloud, table, Step((0.0, 0.0), STEP.reading_uT, 0.5, STEP.motion, 1.0), number, 5).cloud
    np.testing.assert_allclose(np.hypot(*cloud.state[2:4]), 1.0, atol=1e-5)


@pytest.mark.parametrize("step", ["fused", "plain"])
def test_off_the_map_nothing_is_told(grid, step):
    table, cloud = cell_table(grid), cloud_of(300)
    cloud = Cloud(cloud.state + np.array([[1e3], [0], [0], [0], [0]], dtype=np.float32), cloud.weight)
    if step == "fused":
        found = step_fused(cloud, table, STEP, 0, 5)
    else:
        found = step_plain(cloud, table, STEP, normals(300, 0, 5), 0.5)
    assert not found.diverged
    assert found.effective == pytest.approx(300.0, rel=1e-4)


@pytest.mark.parametrize("weight", [0.0, np.nan])
def test_all_lost_is_a_divergence(grid, weight):
    cloud = cloud_of(300)
    lost = Cloud(cloud.state, np.full(300, weight, dtype=np.float32))
    found = step_fused(lost, cell_table(grid), STEP, 0, 5)
    plain = step_plain(lost, cell_table(grid), STEP, normals(300, 0, 5), 0.5)
    for each in (found, plain):
        assert each.diverged
        assert each.effective == pytest.approx(300.0, rel=1e-4)
        assert np.isfinite(each.cloud.state).all()


def test_particles_of_no_weight_leave_no_copies(grid):
    cloud = cloud_of(1000)
    weight = np.zeros(1000, dtype=np.float32)
    weight[[3, 700]] = 0.5
    found = step_fused(Cloud(cloud.state, weight), cell_table(grid), STEP, 0, 5)
    near = [np.hypot(*(found.cloud.state[:2] - cloud.state[:2, k : k + 1])) for k in (3, 700)]
    assert found.resampled
    assert np.all(np.minimum(*near) < 1.2)
    assert [int(np.sum(d < 1.2)) for d in near] == [500, 500]
