"""A magnetised phone walks through a hall it is told nothing of: where it went and what it is are found together."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from app.errors import InvalidInput
from app.field.error_structure import ErrorStructure
from app.positioning.explanation import ExplainedPlace
from app.positioning.floors import prepare_floor
from app.positioning.window import Window
from app.services.calibrate_on_map import calibrate_on_map, offset_by_turns, way_of
from app.synthetic.hall import HALL_CORNERS_M, hall_map, hall_uT

HARD_IRON_UT = np.array([21.0, -18.0, 11.0])
DISTORTION = np.array([[1.06, 0.02, -0.01], [0.02, 0.95, 0.03], [-0.01, 0.03, 1.02]])


@pytest.fixture(scope="module")
def floor():
    grid = hall_map(0.0, ErrorStructure(0.1, 0.3, 0.6, 1.0), 1.0)
    return prepare_floor("hall", grid)


@pytest.fixture(scope="module")
def walk():
    """(places (n, 2), headings (n,), rotations, readings in the phone's axes), 0.2 m apart."""
    rng = np.random.default_rng(5)
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(HALL_CORNERS_M, axis=0), axis=1))])
    s = np.arange(0.0, length[-1], 0.2)
    p = np.stack([np.interp(s, length, HALL_CORNERS_M[:, k]) for k in (0, 1)], axis=1)
    p = gaussian_filter1d(p, 2.0, axis=0, mode="nearest")
    heading = np.unwrap(np.arctan2(*np.gradient(p, axis=0).T[::-1]))
    R = Rotation.from_euler("Z", heading[:, None]).as_matrix()
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


@pytest.mark.parametrize("more_uT", [pytest.param(0.0, marks=pytest.mark.slow), 150.0])
def test_sensor_and_way_are_found_together(floor, walk, more_uT):
    """A hard iron of 30 uT, and one far beyond the field."""
    p, heading, read = walk
    hard_iron_uT = HARD_IRON_UT + more_uT
    found = calibrate_on_map(asked((p, heading, read + more_uT)), [floor], hard_iron_sd_uT=30.0 + more_uT)
    assert found.fix.status == "fix", found.fix.reason
    assert np.sqrt(np.mean(np.sum((found.way.position_m - p) ** 2, axis=1))) < 0.3
    true = np.linalg.solve(DISTORTION, (read - HARD_IRON_UT).T).T
    left = found.fit.model.apply(read + more_uT) - true
    assert np.sqrt(np.mean(np.sum((read - true) ** 2, axis=1))) > 25.0
    assert np.sqrt(np.mean(np.sum(left**2, axis=1))) < 1.0
    sd = np.array([found.fit.parameter_sd[f"hard_iron_{axis}_ut"] for axis in "xyz"])
    assert np.all(np.abs(found.fit.model.hard_iron_uT - hard_iron_uT) < 5.0 * sd)


def test_turns_tell_the_offset_roughly(walk):
    """To the field of steel, of any size, before any map; a straight walk tells nothing level."""
    p, heading, read = walk
    turn = Rotation.from_euler("Z", (heading - heading[0])[:, None]).as_matrix()
    window = asked((p, heading, read + 150.0))
    offset_uT, sd_uT = offset_by_turns(window, turn, -42.0, 200.0)
    assert np.all(np.abs(offset_uT - HARD_IRON_UT - 150.0) < 3.0 * sd_uT)
    assert sd_uT < 8.0
    straight = Window("level", window.B_uT, window.displacement_m, 0.4, yaw_rad=np.zeros(len(p)))
    assert offset_by_turns(straight, np.tile(np.eye(3), (len(p), 1, 1)), -42.0, 200.0)[1] > 15.0


def test_a_way_is_laid_as_told(walk):
    """Scale and heading of an explained place, applied to the window, give the walk back."""
    p, heading, _ = walk
    window = asked(walk)
    zero = np.zeros(0)
    place = ExplainedPlace(
        "hall", (*p[-1], 1.2), float(heading[-1]), 1.0, 0.0, np.zeros(3), 1.03, 0.0, zero, zero, zero
    )
    turn = Rotation.from_euler("Z", window.yaw_rad[:, None]).as_matrix()
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
