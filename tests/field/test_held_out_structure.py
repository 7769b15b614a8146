"""The structure of errors along walks: recovered from errors that have it, and carried with the map."""

import numpy as np
import pytest

from app.field.error_structure import UNKNOWN_STRUCTURE, ErrorStructure, strictest
from app.field.held_out_structure import held_out_structure
from app.field.leave_one_out import HeldOut
from app.services.artefacts import grid_from_bytes, grid_to_bytes


def walks_with(structure: ErrorStructure, count: int, length_m: float, seed: int) -> dict[str, HeldOut]:
    """Errors (one sd stated: 2 uT) of walks sampled every 0.25 m, drawn from the covariance itself."""
    rng = np.random.default_rng(seed)
    path = np.arange(0.0, length_m, 0.25)
    apart = np.abs(path[:, None] - path[None, :])
    covariance = structure.constant_share + structure.walk_share * np.exp(-apart / structure.walk_length_m)
    factor = np.linalg.cholesky(covariance + structure.white_share * np.eye(len(path)))
    return {
        str(k): HeldOut(
            2.0 * factor @ rng.normal(size=(len(path), 3)), np.full((len(path), 3), 2.0),
            np.ones(len(path), dtype=np.bool_), path,
        )
        for k in range(count)
    }  # fmt: skip


@pytest.mark.parametrize(
    "truth",
    [ErrorStructure(0.3, 0.4, 0.2, 2.0), ErrorStructure(0.0, 0.6, 0.4, 1.0), ErrorStructure(0.0, 0.0, 1.0, 1.0)],
)
def test_shares_and_length_are_found_again(truth: ErrorStructure) -> None:
    found = held_out_structure(walks_with(truth, 60, 50.0, seed=0))
    assert found.constant_share == pytest.approx(truth.constant_share, abs=0.07)
    assert found.walk_share == pytest.approx(truth.walk_share, abs=0.1)
    assert found.white_share == pytest.approx(truth.white_share, abs=0.05)
    if truth.walk_share:
        assert found.walk_length_m == pytest.approx(truth.walk_length_m, rel=0.35)


def test_too_little_to_tell_is_unknown() -> None:
    assert held_out_structure({}) == UNKNOWN_STRUCTURE
    assert held_out_structure(walks_with(ErrorStructure(0.3, 0.3, 0.4, 1.0), 1, 2.0, seed=1)) == UNKNOWN_STRUCTURE


def test_floors_that_are_compared_take_the_strictest() -> None:
    a, b = ErrorStructure(0.1, 0.5, 0.2, 1.0), ErrorStructure(0.2, 0.3, 0.3, 4.0)
    assert strictest([a, b]) == ErrorStructure(0.2, 0.5, 0.3, 4.0)


def test_a_map_carries_its_structure() -> None:
    from dataclasses import replace

    from tests.positioning.conftest import make_grid

    grid = replace(make_grid(np.random.default_rng(0), (6, 6)), error_structure=ErrorStructure(0.1, 0.2, 0.3, 4.0))
    assert grid_from_bytes(grid_to_bytes(grid)).error_structure == grid.error_structure
