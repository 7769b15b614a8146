"""Mistakes of units, axes and calibration are named, and a walk among steel is left alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.field.samples import SampleFrame, Samples
from app.geometry import Array, yaw_matrix
from app.survey.earth_check import check_against_earth

EARTH = np.array([18.0, -9.0, -43.0])  # x, y, z up: about 48 uT, dipping 65 deg


def walk(B_uT: Array, frame: SampleFrame = "building") -> Samples:
    n = len(B_uT)
    return Samples(np.arange(n) * 0.1, np.column_stack([np.arange(n) * 0.1, np.zeros((n, 2))]), B_uT, frame)


def among_steel(rng: np.random.Generator, earth: Array = EARTH, n: int = 400) -> Array:
    """The Earth's field and the smooth field of steel along a walk: sd 5 uT an axis."""
    white = rng.normal(size=(n + 60, 3))
    smooth = np.array([np.convolve(white[:, k], np.ones(60) / np.sqrt(60.0), "valid")[:n] for k in range(3)]).T
    return np.asarray(earth + 5.0 * smooth)


@given(seed=st.integers(0, 10_000), turn=st.floats(-np.pi, np.pi), dip=st.floats(-1.4, 1.4))
@settings(max_examples=60)
def test_a_walk_among_steel_is_left_alone(seed: int, turn: float, dip: float) -> None:
    earth = yaw_matrix(turn) @ np.array([50.0 * np.cos(dip), 0.0, -50.0 * np.sin(dip)])
    B = among_steel(np.random.default_rng(seed), earth)
    for frame in ("building", "level"):
        found = check_against_earth(walk(B, frame), earth, bearing_known=True)
        if np.cos(dip) > 0.5:
            assert found.findings == ()
    norm = np.linalg.norm(B, axis=1)[:, None]
    assert check_against_earth(walk(norm, "norm"), earth, bearing_known=True).findings == ()


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        (np.diag([1.0, -1.0, -1.0]), "z looks inverted"),
        (np.diag([1.0, 1.0, -1.0]), "z looks inverted"),
        (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), "y is up"),
        (np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), "x is up"),
        (-np.eye(3), "z looks inverted"),
        (yaw_matrix(np.pi), "turned in the plane"),
        (yaw_matrix(np.pi / 2), "turned in the plane"),
    ],
)
def test_turned_axes_are_named(mistake: Array, said: str) -> None:
    B = among_steel(np.random.default_rng(1)) @ mistake.T
    found = check_against_earth(walk(B), EARTH, bearing_known=True)
    assert any(said in finding for finding in found.findings), found


def test_a_level_walk_upside_down_is_named() -> None:
    B = among_steel(np.random.default_rng(2)) * [1.0, -1.0, -1.0]
    found = check_against_earth(walk(B, "level"), EARTH, bearing_known=False)
    assert ["z looks inverted" in finding for finding in found.findings] == [True]


def test_hard_iron_left_in_is_named() -> None:
    B = among_steel(np.random.default_rng(3), EARTH + np.array([60.0, 20.0, 30.0]))
    found = check_against_earth(walk(B), EARTH, bearing_known=True)
    assert any("hard iron" in finding for finding in found.findings)
    scaled = check_against_earth(walk(0.5 * among_steel(np.random.default_rng(4))), EARTH, bearing_known=True)
    assert any("% less than the Earth's 47 uT" in finding for finding in scaled.findings)


def test_a_wrong_bearing_is_named() -> None:
    B = among_steel(np.random.default_rng(5)) @ yaw_matrix(np.radians(70.0)).T
    found = check_against_earth(walk(B), EARTH, bearing_known=True)
    assert any("bearing_deg" in finding for finding in found.findings)
    assert check_against_earth(walk(B), EARTH, bearing_known=False).findings == ()
