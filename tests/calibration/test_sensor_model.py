"""The model undoes what it does, and neither changes what it is given."""

import numpy as np

from app.calibration.sensor_model import SensorModel


def test_apply_undoes_distort(rng):
    model = SensorModel(100.0 * rng.normal(size=3), np.eye(3) + 0.1 * rng.normal(size=(3, 3)))
    B = 50.0 * rng.normal(size=(20, 3))
    read = model.distort(B)
    np.testing.assert_allclose(read, np.array([np.linalg.solve(model.correction, b) + model.hard_iron_uT for b in B]))
    np.testing.assert_allclose(model.apply(read), B, atol=1e-10)
    np.testing.assert_allclose(model.apply(read[0]), B[0], atol=1e-10)
