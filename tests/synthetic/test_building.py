import numpy as np
import pytest

from app.synthetic import SyntheticBuilding, make_building


def _jacobian(building: SyntheticBuilding, p: np.ndarray, step_m: float = 1e-3) -> np.ndarray:
    """(n, 3, 3) dB_i / dx_j by central differences."""
    columns = [
        (building.field_uT(p + step_m * axis) - building.field_uT(p - step_m * axis)) / (2 * step_m)
        for axis in np.eye(3)
    ]
    return np.stack(columns, axis=-1)


def test_field_has_no_divergence_and_no_curl(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    x0, y0, x1, y1 = building.walkable_m
    p = rng.uniform([x0, y0, 0.8], [x1, y1, 1.6], size=(300, 3))
    J = _jacobian(building, p)
    scale = np.abs(J).max()
    assert np.abs(np.trace(J, axis1=1, axis2=2)).max() < 1e-5 * scale
    assert np.abs(J - np.swapaxes(J, 1, 2)).max() < 1e-5 * scale


def test_field_is_earth_plus_steel(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    p = rng.uniform([2, 2, 1], [12, 10, 1.4], size=(50, 3))
    parts = sum(each.field_uT(p) for each in building.steel)
    np.testing.assert_allclose(building.field_uT(p) - building.earth_uT, parts, atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_field_varies_as_in_real_buildings(seed: int) -> None:
    building = make_building(np.random.default_rng(seed))
    for floor in range(2):
        grid = building.device_grid_m(floor, 0.5)
        B = building.field_uT(grid.reshape(-1, 3)).reshape(grid.shape)
        norm = np.linalg.norm(B, axis=-1)
        assert norm.min() >= 25.0
        assert norm.max() <= 75.0
        assert np.all((B.std(axis=(0, 1)) > 3.0) & (B.std(axis=(0, 1)) < 7.5))
        assert 2.0 <= np.mean([_correlation_length_m(B[..., c], 0.5) for c in range(3)]) <= 6.0


def _correlation_length_m(field: np.ndarray, spacing_m: float) -> float:
    """Distance at which the autocorrelation, averaged over both axes, falls below 1/e."""
    f = field - field.mean()
    for lag in range(1, min(f.shape)):
        ahead = np.mean(f[lag:] * f[:-lag]) + np.mean(f[:, lag:] * f[:, :-lag])
        if ahead < 2 * np.exp(-1) * f.var():
            return lag * spacing_m
    return np.inf


def test_field_near_walkers_has_no_singularity(building: SyntheticBuilding) -> None:
    """No source within a metre of the device, and a bounded gradient."""
    for floor, elevation in enumerate(building.elevations_m):
        grid = building.device_grid_m(floor, 0.5).reshape(-1, 3)
        assert grid[:, 2] == pytest.approx(elevation + 1.2)
        assert np.abs(_jacobian(building, grid)).max() < 40.0
        for steel in building.steel:
            nearest = min(np.linalg.norm(grid - each, axis=1).min() for each in steel.position_m)
            assert nearest > 1.0


def test_floors_differ(building: SyntheticBuilding) -> None:
    ground, upper = (building.field_uT(building.device_grid_m(k).reshape(-1, 3)) for k in (0, 1))
    for c in range(3):
        assert abs(np.corrcoef(ground[:, c], upper[:, c])[0, 1]) < 0.5


def test_strength_of_the_field_can_be_chosen() -> None:
    weak = make_building(np.random.default_rng(3), width_m=20, depth_m=20, floors=1, field_sd_uT=0.5)
    B = weak.field_uT(weak.device_grid_m(0).reshape(-1, 3))
    assert np.sqrt(np.mean(B.var(axis=0))) == pytest.approx(0.5, rel=1e-6)


def test_same_seed_same_building() -> None:
    first, second = (make_building(np.random.default_rng(5), width_m=12, depth_m=10) for _ in range(2))
    p = first.device_grid_m(1).reshape(-1, 3)
    np.testing.assert_array_equal(first.field_uT(p), second.field_uT(p))
    other = make_building(np.random.default_rng(6), width_m=12, depth_m=10)
    assert np.abs(other.field_uT(p) - first.field_uT(p)).max() > 1.0


def test_earth_has_the_strength_and_inclination_asked_for() -> None:
    building = make_building(
        np.random.default_rng(0), width_m=10, depth_m=10, earth_uT=50.0, inclination_rad=np.deg2rad(45.0)
    )
    assert np.linalg.norm(building.earth_uT) == pytest.approx(50.0)
    assert building.earth_uT[2] == pytest.approx(-50.0 * np.sqrt(0.5))
