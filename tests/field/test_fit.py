import numpy as np

from app.field.fit import fit_map
from app.field.spec import MapSpec


def test_the_map_of_a_room_predicts_its_field_within_the_stated_uncertainty(room):
    fitted = fit_map(room.lanes(np.random.default_rng(1)), MapSpec(resolution_m=0.25))
    x, y = np.meshgrid(np.arange(0.5, room.width_m, 0.3), np.arange(0.5, room.depth_m, 0.3))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    values = fitted.grid.at(points)
    error = values.mean_uT - room.field_uT(points)
    assert values.measured.mean() > 0.95
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert np.mean(np.abs(error) <= 2 * values.sd_uT) > 0.9
    assert fitted.score is not None
    assert all(0.92 < c <= 1.0 for c in fitted.score.coverage_2sigma)
