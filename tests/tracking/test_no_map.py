"""The hypothesis of no map, told reading after reading, is the evidence of all readings at once."""

from collections.abc import Callable

import numpy as np
import pytest

from app.field.error_structure import ErrorStructure
from app.positioning.floors import SearchableFloor
from app.tracking.no_map import predict_without_map, without_map
from app.tracking.places import make_places


def test_step_after_step_it_is_one_gaussian(floor_of: Callable[..., SearchableFloor]) -> None:
    rng = np.random.default_rng(1)
    structure = ErrorStructure(0.1, 0.5, 0.3, 2.0)
    places = make_places([floor_of(rng, structure=structure)])
    n, offset, noise = 25, 1.7, 0.2
    moved = np.concatenate([[0.0], rng.uniform(0.1, 0.6, n - 1)])
    B = places.ambient_uT + np.cumsum(rng.normal(0, 0.5, (n, 3)), axis=0)
    nothing, total = without_map(places, offset), 0.0
    for k in range(n):
        nothing, log_density = predict_without_map(nothing, B[k], float(moved[k]), noise, places)
        total += log_density
    d = np.abs(np.subtract.outer(np.cumsum(moved), np.cumsum(moved)))
    walk, white, rough, _, smooth = places.errors
    V = places.typical_variance_uT2
    errors = walk * V * np.exp(-d * rough) + (white * V + noise) * np.eye(n)
    horizontal = offset + 0.5 * float(np.sum(np.square(places.ambient_uT[:2])))
    exact = 0.0
    for k in range(3):
        C = errors + places.prior_variance_uT2[k] * np.exp(-d * smooth) + (offset if k == 2 else horizontal)
        r = B[:, k] - (places.ambient_uT[k] if k == 2 else 0.0)
        exact -= 0.5 * float(r @ np.linalg.solve(C, r) + np.linalg.slogdet(2 * np.pi * C)[1])
    assert total == pytest.approx(exact, abs=1e-6)
