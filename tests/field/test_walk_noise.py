import numpy as np
import pytest

from app.field.walk_noise import WHITE, WalkNoise, whiten


@pytest.mark.parametrize("noise", [WHITE, WalkNoise(3.0, 1.2), WalkNoise(0.01, 40.0), WalkNoise(50.0, 0.2)])
def test_whitening_equals_the_dense_covariance(noise):
    rng = np.random.default_rng(0)
    path = np.sort(rng.uniform(0.0, 12.0, 40))
    path[20:25] = path[20]  # standing still
    columns = rng.normal(size=(40, 3))
    dense = np.eye(40) + noise.variance_ratio * np.exp(-np.abs(path[:, None] - path) / noise.length_m)
    white, log_det = whiten(columns, path, noise)
    assert np.allclose(white.T @ white, columns.T @ np.linalg.solve(dense, columns), rtol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(dense)[1], abs=1e-8)
    scale = rng.uniform(0.5, 4.0, 40)
    dense += np.diag(scale - 1.0)
    white, log_det = whiten(columns, path, noise, scale)
    assert np.allclose(white.T @ white, columns.T @ np.linalg.solve(dense, columns), rtol=1e-9)
    assert log_det == pytest.approx(np.linalg.slogdet(dense)[1], abs=1e-8)
