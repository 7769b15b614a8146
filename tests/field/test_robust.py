from dataclasses import replace

import numpy as np

from app.field.fit import fit_map
from app.field.spec import MapSpec


def test_stray_readings_bend_a_robust_map_less(room):
    rng = np.random.default_rng(3)
    walks = room.lanes(rng, surveys=3)
    for name, walk in walks.items():
        stray = rng.random(len(walk)) < 0.02
        walks[name] = replace(walk, B_uT=walk.B_uT + stray[:, None] * rng.normal(0.0, 25.0, (len(walk), 3)))
    x, y = np.meshgrid(np.arange(1.0, 11.0, 0.3), np.arange(1.0, 8.0, 0.3))
    p = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])

    def rmse(robust):
        grid = fit_map(walks, MapSpec(resolution_m=0.5, robust=robust)).grid
        return np.sqrt(np.mean(np.square(grid.at(p).mean_uT - room.field_uT(p))))

    assert rmse(robust=True) < 0.8 * rmse(robust=False)
