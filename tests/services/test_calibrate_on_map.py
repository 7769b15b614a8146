"""A magnetised phone walks through a hall it is told nothing of: where it went and what it is are found together."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from app.errors import InvalidInput
from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.positioning.explanation import ExplainedPlace
from app.positioning.floors import prepare_floor
from app.positioning.window import Window
from app.services.calibrate_on_map import calibrate_on_map, way_of

HARD_IRON_UT = np.array([21.0, -18.0, 11.0])
DISTORTION = np.array([[1.06, 0.02, -0.01], [0.02, 0.95, 0.03], [-0.01, 0.03, 1.02]])
CORNERS_M = np.array([[1.0, 1.0], [10.5, 6.5], [10.5, 2.0], [2.0, 5.5], [9.0, 1.0], [2.0, 2.0], [10.0, 7.0]])


def hall_uT(x, y):
    """(..., 3) of a hall of 12 m by 8 m."""
    return np.stack(
        [
            18 + 6 * np.sin(0.9 * x + 0.3) * np.cos(0.7 * y),
            3 + 5 * np.cos(0.6 * x - 0.8 * y),
            -42 + 6 * np.sin(0.5 * x + 1.1 * y),
        ],
        axis=-1,
    )


@pytest.fixture(scope="module")
def floor():
    x, y = np.meshgrid(np.arange(0.0, 12.01, 0.25), np.arange(0.0, 8.01, 0.25))
    mean = hall_uT(x, y)[None]
    gradient = np.stack([np.gradient(mean, 0.25, axis=2), np.gradient(mean, 0.25, axis=1)], axis=-1)
    grid = FieldGrid(
        "vector", (0.0, 0.0), 0.25, np.array([1.2]), mean.astype(np.float32), np.full(mean.shape, 0.3, np.float32),
        gradient.astype(np.float32), np.ones(mean.shape[:3], dtype=np.bool_), np.array([18.0, 3.0, -42.0]),
        np.full(3, 5.0), np.full(3, 0.4), 1.0, ErrorStructure(0.1, 0.3, 0.6, 1.0),
    )  # fmt: skip
    return prepare_floor("hall", grid)


@pytest.fixture(scope="module")
def walk():
    """(places (n, 2), headings (n,), rotations, readings in the phone's axes), 0.2 m apart."""
    rng = np.random.default_rng(5)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(CORNERS_M, axis=0), axis=1))])
    s = np.arange(0.0, length[-1], 0.2)
    p = np.stack([np.interp(s, length, CORNERS_M[:, k]) for k in (0, 1)], axis=1)
    p = gaussian_filter1d(p, 2.0, axis=0, mode="nearest")
    heading = np.unwrap(np.arctan2(*np.gradient(p, axis=0).T[::-1]))
    c, s, zero, one = np.cos(heading), np.sin(heading), np.zeros(len(p)), np.ones(len(p))
    R = np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]), 2, 0)
    read = np.einsum("nji,nj->ni", R, hall_uT(*p.T)) @ DISTORTION.T + HARD_IRON_UT
    return p, heading, read + 0.4 * rng.normal(size=(len(p), 3))


def asked(walk, scale=1.03):
    """The window: in the level frame of the first sample, its steps told 3 % too short."""
    p, heading, read = walk
    turned = heading - heading[0]
    c, s = np.cos(turned), np.sin(turned)
    B = np.stack([c * read[:, 0] - s * read[:, 1], s * read[:, 0] + c * read[:, 1], read[:, 2]], axis=1)
    d = (p - p[0]) / scale
    c, s = np.cos(-heading[0]), np.sin(-heading[0])
    moved = np.stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], np.zeros(len(d))], axis=1)
    return Window("level", B, moved, 0.4, yaw_rad=turned)


def test_sensor_and_way_are_found_together(floor, walk):
    found = calibrate_on_map(asked(walk), [floor])
    p, _, read = walk
    assert found.fix.status == "fix", found.fix.reason
    assert np.sqrt(np.mean(np.sum((found.way.position_m - p) ** 2, axis=1))) < 0.3
    true = np.linalg.solve(DISTORTION, (read - HARD_IRON_UT).T).T
    left = found.fit.model.apply(read) - true
    assert np.sqrt(np.mean(np.sum((read - true) ** 2, axis=1))) > 25.0
    assert np.sqrt(np.mean(np.sum(left**2, axis=1))) < 1.0
    sd = np.array([found.fit.parameter_sd[f"hard_iron_{axis}_ut"] for axis in "xyz"])
    assert np.all(np.abs(found.fit.model.hard_iron_uT - HARD_IRON_UT) < 5.0 * sd)


def test_a_way_is_laid_as_told(walk):
    """Scale and heading of an explained place, applied to the window, give the walk back."""
    p, heading, _ = walk
    window = asked(walk)
    zero = np.zeros(0)
    place = ExplainedPlace(
        "hall", (*p[-1], 1.2), float(heading[-1]), 1.0, 0.0, np.zeros(3), 1.03, 0.0, zero, zero, zero
    )
    c, s = np.cos(window.yaw_rad), np.sin(window.yaw_rad)
    zeros, ones = np.zeros(len(p)), np.ones(len(p))
    turn = np.moveaxis(np.array([[c, -s, zeros], [s, c, zeros], [zeros, zeros, ones]]), 2, 0)
    way = way_of(window, turn, place, 0.01 * np.eye(2))
    np.testing.assert_allclose(way.position_m, p, atol=1e-9)
    np.testing.assert_allclose(np.arctan2(way.rotation[:, 1, 0], way.rotation[:, 0, 0]) % (2 * np.pi),
                               heading % (2 * np.pi), atol=1e-9)  # fmt: skip


def test_how_the_device_turned_must_be_told(floor, walk):
    window = asked(walk)
    with pytest.raises(InvalidInput, match="yaw_rad"):
        calibrate_on_map(replace(window, yaw_rad=None), [floor])
    with pytest.raises(InvalidInput, match="level frame"):
        calibrate_on_map(replace(window, frame="building"), [floor])
