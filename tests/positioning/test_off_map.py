"""The off-map hypothesis: its evidence against the density it claims to be, and windows from other buildings."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

from app.errors import InvalidInput
from app.field.grid import FieldGrid
from app.field.kernels import covariance
from app.positioning.fix import Fix, Prior
from app.positioning.lattice import MOST_SAMPLES, reduce_window
from app.positioning.locate import locate, prepare_floor
from app.positioning.off_map import ProcessPrior, process_evidence, process_prior
from app.positioning.window import Window


def smooth_world(grid_of: Callable, seed: int, shape: tuple[int, int] = (80, 100)) -> FieldGrid:
    grid: FieldGrid = grid_of(np.random.default_rng(seed), shape, length_m=1.5, noise_sd_uT=0.6)
    return grid


def searched_reach_m(fix: Fix, grid: FieldGrid) -> float:
    """From the stated position to the farthest corner of the grid."""
    assert fix.posterior is not None
    x, y, _ = fix.posterior.position_m
    x0, y0, _, x1, y1, _ = grid.bounds_m
    return float(np.hypot(max(x - x0, x1 - x), max(y - y0, y1 - y)))


@pytest.mark.parametrize("demeaned", [False, True])
def test_evidence_is_the_density_of_the_process(demeaned: bool) -> None:
    rng = np.random.default_rng(0)
    n, prior = 7, ProcessPrior(np.array([20.0, 35.0]), 3.0)
    position, residual = rng.uniform(0, 8, (n, 2)), rng.normal(0.0, 4.0, (3, n, 2))
    errors = np.diag(rng.uniform(0.2, 1.0, n)) + 0.1
    found = process_evidence(residual, position, errors, prior, 0.0 if demeaned else None)
    vague = 1e6 if demeaned else 0.0  # an offset of sd 1000 uT stands for the flat prior
    for h in range(3):
        expected = 0.0
        for c in range(2):
            K = prior.variance_uT2[c] * covariance("matern32", cdist(position, position), 3.0)
            density = multivariate_normal(np.zeros(n), K + errors + vague)
            expected += density.logpdf(residual[h, :, c]) + (0.5 * np.log(2 * np.pi * vague) if demeaned else 0.0)
        assert found.log_l[h] == pytest.approx(expected, abs=2e-3)


def test_samples_close_together_are_charged_once() -> None:
    """Twenty readings of one place by a noiseless sensor say what one of them says."""
    prior = ProcessPrior(np.array([25.0]), 3.0)
    many = process_evidence(np.full((1, 20, 1), 4.0), np.zeros((20, 2)), 1e-3 * np.eye(20), prior, None)
    assert many.distance2[0] == pytest.approx(16.0 / 25.0, rel=1e-3)


def test_length_scale_is_that_of_the_field(grid_of: Callable) -> None:
    """A Gaussian-filtered field has correlation length sqrt(2) sigma, and mean squared gradient 2 s^2 / length^2."""
    grid = grid_of(np.random.default_rng(1), (200, 200), length_m=1.5, field_sd_uT=5.0)
    (plane,) = prepare_floor("a", grid).planes
    found = process_prior(plane, np.full(3, 25.0)).length_m
    assert found == pytest.approx(np.sqrt(3.0) * np.sqrt(2.0) * 1.5, rel=0.1)
    flat = grid_of(np.random.default_rng(1), (40, 40), field_sd_uT=0.0)
    assert process_prior(prepare_floor("a", flat).planes[0], np.full(3, 25.0)).length_m == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("frame", "length_m", "composition"), [("level", 5.0, "raw"), ("level", 6.0, "demeaned"), ("norm", 16.0, "raw")]
)
def test_windows_from_another_building_are_no_fixes(
    frame: str, length_m: float, composition: str, grid_of: Callable, walk_on: Callable
) -> None:
    here, elsewhere = smooth_world(grid_of, 2), smooth_world(grid_of, 3)
    floors, rng = [prepare_floor("a", here)], np.random.default_rng(4)
    own, foreign = [], []
    for _ in range(8):
        for world, fixes in ((here, own), (elsewhere, foreign)):
            walked = walk_on(rng, world, frame, length_m, int(2 * length_m) + 1)
            fixes.append(locate(walked.window, floors, composition=composition))
    assert [fix.status for fix in own].count("fix") >= 7
    assert "fix" not in [fix.status for fix in foreign]
    unmapped = [fix for fix in foreign if fix.status == "unmapped"]
    assert len(unmapped) >= 6
    for fix in unmapped:
        assert fix.posterior is not None
        assert fix.posterior.radius_95_m == pytest.approx(searched_reach_m(fix, here))
        assert fix.posterior.covariance_m2.shape == (2, 2)
        assert fix.reason is not None
        assert "demeaned" in fix.reason


def test_empty_cells_of_a_grid_do_not_make_the_hypothesis_likelier(grid_of: Callable, walk_on: Callable) -> None:
    """A margin without samples around the same map: more poses, none of them on the map."""
    world = smooth_world(grid_of, 7, (40, 40))
    margin = ((0, 0), (60, 60), (60, 60), (0, 0))
    x0, y0 = world.origin_m
    ambient = np.where(np.pad(world.measured, margin[:3])[..., None], 0.0, world.ambient_uT).astype(np.float32)
    padded = dataclasses.replace(
        world,
        origin_m=(x0 - 60 * world.resolution_m, y0 - 60 * world.resolution_m),
        mean_uT=np.pad(world.mean_uT, margin) + ambient,
        sd_uT=np.pad(world.sd_uT, margin),
        gradient_uT_per_m=np.pad(world.gradient_uT_per_m, (*margin, (0, 0))),
        measured=np.pad(world.measured, margin[:3]),
    )
    rng = np.random.default_rng(8)
    for _ in range(3):
        window = walk_on(rng, world, length_m=2.0).window
        alone, within = (locate(window, [prepare_floor("a", grid)]).posterior for grid in (world, padded))
        assert alone is not None
        assert within is not None
        assert within.off_map_probability == pytest.approx(alone.off_map_probability, rel=0.1)


def test_the_refined_position_stays_on_the_grid(grid_of: Callable, walk_on: Callable) -> None:
    world = smooth_world(grid_of, 7, (24, 24))
    x0, y0, _, x1, y1, _ = world.bounds_m
    floors, rng = [prepare_floor("a", world)], np.random.default_rng(8)
    for _ in range(12):
        fix = locate(walk_on(rng, smooth_world(grid_of, 9), length_m=3.0).window, floors)
        assert fix.ml is not None
        assert x0 <= fix.ml.position_m[0] <= x1
        assert y0 <= fix.ml.position_m[1] <= y1


def test_long_windows_are_thinned(grid_of: Callable) -> None:
    n = 2000
    displacement = np.column_stack([0.25 * np.arange(n), np.zeros((n, 2))])
    window = Window("norm", np.arange(n)[:, None] + 0.0, displacement, 0.5)
    reduced = reduce_window(window, "norm", 0.25)
    assert len(reduced) == MOST_SAMPLES
    assert reduced.path_m[0] == 0.0
    np.testing.assert_array_equal(reduced.from_last_m[-1], 0.0)
    np.testing.assert_allclose(reduced.features_uT[:, 0], 4.0 * reduced.path_m)
    assert np.ptp(np.diff(reduced.path_m)) <= 0.25 + 1e-9


@pytest.mark.parametrize("sd_m", [1e-160, 9e-4])
def test_positions_known_impossibly_well_are_refused(sd_m: float, grid_of: Callable, walk_on: Callable) -> None:
    world = smooth_world(grid_of, 2, (20, 20))
    walked = walk_on(np.random.default_rng(0), world)
    with pytest.raises(InvalidInput, match="sd_m"):
        locate(walked.window, [prepare_floor("a", world)], prior=Prior((0.0, 8.0, 1.2), sd_m))


@pytest.mark.parametrize("sd_rad", [1e-200, 9e-5])
def test_headings_known_impossibly_well_are_refused(sd_rad: float, grid_of: Callable, walk_on: Callable) -> None:
    world = smooth_world(grid_of, 2, (20, 20))
    window = dataclasses.replace(
        walk_on(np.random.default_rng(0), world).window, heading_rad=0.0, heading_sd_rad=sd_rad
    )
    with pytest.raises(InvalidInput, match="heading_sd_rad"):
        locate(window, [prepare_floor("a", world)])


@pytest.mark.parametrize("offset_uT", [pytest.param(60.0, marks=pytest.mark.slow), 5000.0])
def test_a_field_that_is_nowhere_here_overflows_nothing(offset_uT: float, grid_of: Callable, walk_on: Callable) -> None:
    world = smooth_world(grid_of, 2)
    walked = walk_on(np.random.default_rng(1), world, length_m=10.0, samples=40, offset_uT=offset_uT)
    fix = locate(walked.window, [prepare_floor("a", world)])
    assert fix.status in ("unmapped", "inconsistent")
    assert fix.posterior is not None
    assert fix.posterior.off_map_probability > 0.99


def test_radii_hold_what_labels_of_the_map_err_by(grid_of: Callable, walk_on: Callable) -> None:
    """Two metres per axis: 68 % of a Gaussian in the plane lie within 1.51 sds, 95 % within 2.45."""
    world = smooth_world(grid_of, 2)
    vague = dataclasses.replace(world, error_structure=dataclasses.replace(world.error_structure, position_sd_m=2.0))
    window = walk_on(np.random.default_rng(4), world, length_m=8.0, samples=33).window
    sure, unsure = (locate(window, [prepare_floor("a", grid)]).posterior for grid in (world, vague))
    assert sure is not None
    assert unsure is not None
    assert sure.radius_95_m < 0.5
    assert unsure.radius_68_m == pytest.approx(1.51 * 2.0, rel=0.1)
    assert unsure.radius_95_m == pytest.approx(2.45 * 2.0, rel=0.1)
    np.testing.assert_allclose(unsure.position_m, sure.position_m, atol=0.3)
