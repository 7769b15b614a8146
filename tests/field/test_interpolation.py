import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from app.errors import InvalidInput
from app.field.fit import fit_map
from app.field.interpolation import interpolation_ratio
from app.field.spec import MapSpec


@pytest.mark.parametrize("length_m", [0.8, 1.5, 4.0])
def test_it_is_what_interpolating_random_smooth_fields_loses(length_m):
    rng = np.random.default_rng(0)
    k = rng.normal(0.0, 1.0 / length_m, (9000, 2)) * np.sqrt(5.0 / rng.chisquare(5.0, (9000, 1)))  # of a Matern 5/2
    phase = rng.uniform(0.0, 2.0 * np.pi, 9000)

    def field(points):
        return np.sqrt(2.0) * np.cos(points @ k.T + phase)  # every column a field of unit variance, in the mean

    cells = np.arange(4.0)
    corners = np.stack(np.meshgrid(cells, cells, indexing="ij"), axis=-1)
    points = rng.uniform(0.0, 3.0, (200, 2))
    between = RegularGridInterpolator((cells, cells), field(corners.reshape(-1, 2)).reshape(4, 4, -1))(points)
    lost = np.mean(np.square(field(points) - between))
    assert interpolation_ratio(length_m, 1.0) == pytest.approx(lost, rel=0.15)


def test_a_fine_grid_loses_nothing_and_a_very_coarse_one_is_refused():
    assert 0.0 <= interpolation_ratio(3.0, 0.1) < 1e-6
    with pytest.raises(InvalidInput, match="too coarse"):
        interpolation_ratio(1.0, 5.0)


def test_a_coarse_map_says_how_little_it_tells(room):
    walks = room.lanes(np.random.default_rng(1), surveys=4, lane_m=1.0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(2.0, 10.0, 0.4), np.arange(2.0, 7.0, 0.4)))
    points = np.column_stack([x, y, np.zeros(len(x))])
    values = fit_map(walks, MapSpec(resolution_m=1.5)).grid.at(points)
    z = (values.mean_uT - room.field_uT(points))[values.measured] / values.sd_uT[values.measured]
    assert 0.5 < np.sqrt(np.mean(np.square(z))) < 1.5
