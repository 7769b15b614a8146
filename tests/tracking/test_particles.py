"""Particles: the filter each carries against the whole covariance at once, compiled loops against plain ones."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from app.field.error_structure import ErrorStructure
from app.geometry import yaw_matrix
from app.positioning.floors import SearchableFloor
from app.positioning.window_error import weigh_residuals, window_error
from app.tracking.ground import barriers_of
from app.tracking.particle_filter import effective_sample_size
from app.tracking.particles import (
    DRAWS,
    HEADING,
    MEASURED,
    SCALE,
    Advance,
    Particles,
    advance,
    log_evidence,
    new_particles,
    resample,
    weights,
)
from app.tracking.places import Places, make_places

Array = NDArray[np.float64]
STRUCTURE = ErrorStructure(0.0, 0.5, 0.4, 2.0)
STILL = np.array([0.0, 0.0, 1.0, 0.0, 1.0, 0.0])


def move(moved: tuple[float, float], features: Array | None, yaw: float = 0.0, walk: Array = STILL) -> Advance:
    return Advance(np.array(moved), float(np.hypot(*moved)), 0.0, features, 0.04, yaw_matrix(-yaw), walk, True)


def no_walls(places: Places) -> object:
    return barriers_of({}, [str(k) for k in range(places.count)])


@pytest.fixture
def places(floor_of: Callable[..., SearchableFloor]) -> Places:
    return make_places([floor_of(np.random.default_rng(1), structure=STRUCTURE)])


def test_the_weights_of_a_path_are_the_density_of_its_residuals_all_at_once(places: Places) -> None:
    """Step after step, the filter over offset and walk noise gives what `window_error` gives of the whole window."""
    rng = np.random.default_rng(2)
    start, heading, offset_sd = np.array([4.0, 5.0, 1.2]), 0.7, 1.5
    particles = new_particles(start[None], np.zeros(1, dtype=int), np.array([heading]), offset_sd**2)
    readings = [(0.0, 0.0)] + [tuple(rng.uniform(0.1, 0.4, 2)) for _ in range(11)]
    features, residuals, path = rng.normal(AMBIENT_LEVEL, 3.0, size=(12, 3)), [], [0.0]
    yaws = np.cumsum(rng.normal(0.0, 0.3, 12))
    plain = naive(places)
    position, variances = start[:2].copy(), []
    for k, moved in enumerate(readings):
        particles = advance(particles, move(moved, features[k], yaws[k]), places, no_walls(places), zeros(1))  # type: ignore[arg-type]
        position = position + yaw_matrix(heading)[:2, :2] @ moved
        mean, variance, measured = plain(position)
        assert measured == 1.0
        residuals.append(yaw_matrix(-yaws[k]) @ (features[k] - yaw_matrix(-heading) @ mean))
        variances.append(variance)
        path.append(path[-1] + float(np.hypot(*moved)))
    V = float(np.mean(variances))
    np.testing.assert_allclose(variances, V, rtol=1e-6)  # the map's sd is the same everywhere
    error = window_error(np.array(path[1:]), np.full(12, 0.04), V, STRUCTURE, offset_sd)
    own = STRUCTURE.walk_share + STRUCTURE.white_share
    whole = weigh_residuals(np.array(residuals), np.full(12, own * V + 0.04), error)
    assert float(particles.log_weight[0]) == pytest.approx(float(whole.log_l), abs=1e-6)


AMBIENT_LEVEL = np.array([18.0, 2.0, -43.0])


def zeros(n: int) -> NDArray[np.float32]:
    return np.zeros((n, DRAWS), dtype=np.float32)


def naive(places: Places) -> Callable[[Array], tuple[Array, float, float]]:
    """Bilinear values of the one plane there is, written plainly."""
    _, ny, nx = places.shapes[0]
    cells = places.cells.reshape(ny, nx, -1).astype(np.float64)

    def at(position: Array) -> tuple[Array, float, float]:
        u, v = (position - places.planes[0, :2]) / places.resolution_m[0]
        i, j = int(np.floor(u)), int(np.floor(v))
        total, measured = np.zeros(cells.shape[2]), 0.0
        for dj in (0, 1):
            for di in (0, 1):
                w = (u - i if di else 1 - u + i) * (v - j if dj else 1 - v + j)
                row, column = np.clip([j + dj, i + di], 0, [ny - 1, nx - 1])
                total += w * cells[row, column]
                measured += w * cells[row, column, -1] * ((row, column) == (j + dj, i + di))
        return total[:3], float(total[3]), measured

    return at


def plain_advance(particles: Particles, by: Advance, places: Places, noise: Array) -> Particles:
    """The twin: one particle at a time, its filter in matrices."""
    at, rows, log_weight = naive(places), particles.rows.copy(), particles.log_weight.copy()
    for i, row in enumerate(rows):
        heading = row[HEADING] + 0.5 * row[6] * by.distance_m + by.walk[0] * noise[i, 0]
        row[4] = by.walk[2] * row[4] + by.walk[3] * noise[i, 3]
        row[SCALE] = 1.0 + by.walk[4] * (row[SCALE] - 1.0) + by.walk[5] * noise[i, 4]
        row[:2] += row[SCALE] * yaw_matrix(heading + row[4])[:2, :2] @ by.moved_m + by.walk[1] * noise[i, 1:3]
        row[HEADING] = heading + 0.5 * row[6] * by.distance_m
        row[2] += by.risen_m
        assert by.features_uT is not None
        mean, variance, measured = at(row[:2])
        kept = np.exp(-by.distance_m / 5.0)
        row[MEASURED] = kept * row[MEASURED] + (1 - kept) * measured
        P = np.array([[row[8], row[9], row[10]], [row[9], row[11], row[12]], [row[10], row[12], row[13]]])
        F = np.diag([1.0, np.exp(-by.distance_m * places.errors[2]), np.exp(-by.distance_m * places.errors[4])])
        P = F @ P @ F + np.diag(1.0 - np.diag(F) ** 2)
        h = np.array([1.0, np.sqrt(places.errors[0] * variance), places.errors[3] * np.sqrt(1.0 - measured)])
        S = h @ P @ h + places.errors[1] * variance + by.noise_uT2
        K = P @ h / S
        residual = by.turn @ (by.features_uT - yaw_matrix(-row[HEADING]) @ mean)
        for k in range(3):
            x = F @ row[[14 + k, 17 + k, 20 + k]]
            innovation = residual[k] - h @ x
            row[[14 + k, 17 + k, 20 + k]] = x + K * innovation
            log_weight[i] -= 0.5 * (innovation**2 / S + np.log(2 * np.pi * S))
        P = P - np.outer(K, h @ P)
        row[8:14] = P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2]
    return Particles(rows, particles.floor, log_weight)


def test_compiled_steps_are_the_plain_ones(floor_of: Callable[..., SearchableFloor]) -> None:
    rng = np.random.default_rng(3)
    measured = np.ones((60, 60), dtype=bool)
    measured[20:40, 10:30] = False
    places = make_places([floor_of(rng, structure=STRUCTURE, measured=measured)])
    n = 60
    particles = new_particles(
        np.column_stack([rng.uniform(-1, 16, (n, 2)), np.full(n, 1.2)]), np.zeros(n, dtype=int),
        rng.uniform(-3, 3, n), 2.0,
    )  # fmt: skip
    particles.rows[:, [4, 6]] = 0.1 * rng.normal(size=(n, 2))
    compiled = plain = particles
    walk = np.array([0.02, 0.1, 0.9, 0.05, 0.95, 0.03])
    for k in range(6):
        noise = rng.standard_normal((n, DRAWS), dtype=np.float32)
        by = move((0.3, -0.1), rng.normal(AMBIENT_LEVEL, 4.0), 0.2 * k, walk)
        compiled = advance(compiled, by, places, no_walls(places), noise)  # type: ignore[arg-type]
        plain = plain_advance(plain, by, places, noise.astype(np.float64))
    np.testing.assert_allclose(compiled.rows, plain.rows, rtol=1e-5, atol=1e-5)  # one less measured: rounded
    np.testing.assert_allclose(compiled.log_weight, plain.log_weight, rtol=1e-6)


def test_what_is_not_mapped_neither_gains_nor_loses_by_readings_of_a_smooth_field(places: Places) -> None:
    """Far off the map a particle predicts the field there as a smooth process: its log density is that process's."""
    rng = np.random.default_rng(4)
    particles = new_particles(np.array([[500.0, 500.0, 1.2]]), np.zeros(1, dtype=int), np.zeros(1), 0.0)
    steps, B = 40, AMBIENT_LEVEL + np.cumsum(rng.normal(0, 0.3, (40, 3)), axis=0)
    for k in range(steps):
        particles = advance(particles, move((0.25, 0.0), B[k]), places, no_walls(places), zeros(1))  # type: ignore[arg-type]
    assert particles.rows[0, MEASURED] < 0.2
    edge = places.cells.reshape(60, 60, -1)[-1, -1]  # the nearest cell's values are what the constant is about
    d = 0.25 * np.abs(np.subtract.outer(np.arange(steps), np.arange(steps)))
    V, (walk, white, rough, sd, smooth) = float(edge[3]), places.errors
    C = walk * V * np.exp(-d * rough) + sd**2 * np.exp(-d * smooth) + (white * V + 0.04) * np.eye(steps)
    r = B - edge[:3]
    exact = -0.5 * (np.sum(r * np.linalg.solve(C, r)) + 3 * np.linalg.slogdet(2 * np.pi * C)[1])
    assert float(particles.log_weight[0]) == pytest.approx(exact, rel=1e-9)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10_000), st.integers(2, 40), st.integers(1, 60))
def test_resampling_draws_in_proportion_and_keeps_the_whole_weight(seed: int, n: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    particles = Particles(rng.normal(size=(n, 23)), rng.integers(3, size=n), rng.normal(0, 2, n))
    weight = weights(particles)
    drawn, chosen = resample(particles, weight, count, float(rng.uniform()))
    times = np.bincount(chosen, minlength=n)
    assert np.all(np.abs(times - count * weight) < 1.0 + 1e-9)
    assert log_evidence(drawn) == pytest.approx(log_evidence(particles))
    np.testing.assert_array_equal(drawn.rows, particles.rows[chosen])
    assert effective_sample_size(weights(drawn)) == pytest.approx(count)


def test_a_wall_costs_those_who_walk_through_it(places: Places) -> None:
    walls = {"0": np.array([[[5.0, 0.0], [5.0, 15.0]]])}
    particles = new_particles(
        np.array([[4.9, 7.0, 1.2], [4.9, 7.0, 1.2]]), np.zeros(2, dtype=int), np.array([0.0, np.pi]), 1.0
    )
    moved = advance(particles, move((0.3, 0.0), None), places, barriers_of(walls, ["0"]), zeros(2))
    assert moved.log_weight[0] < -5.0
    assert moved.log_weight[1] == 0.0


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000))
def test_walls_in_buckets_stop_what_any_wall_stops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    segments = rng.uniform(-7, 7, (12, 2, 2))
    a, b = rng.uniform(-8, 8, (2, 40, 2))
    far = rng.uniform(size=40) < 0.7
    b[far] = a[far] + rng.normal(0, 0.5, (int(far.sum()), 2))
    floor = replaced_floor()
    particles = new_particles(np.column_stack([a, np.full(40, 1.2)]), np.zeros(40, dtype=int), np.zeros(40), 1.0)
    for k in range(40):
        one = Particles(particles.rows[k : k + 1], particles.floor[k : k + 1], particles.log_weight[k : k + 1])
        by = replace(move(tuple(b[k] - a[k]), None), walk=STILL)
        got = advance(one, by, floor, barriers_of({"0": segments}, ["0"]), zeros(1)).log_weight[0] < 0.0
        assert got == any(_meet(a[k], b[k], *segment) for segment in segments)


def _meet(a: Array, b: Array, c: Array, d: Array) -> bool:
    def side(p: Array, q: Array, r: Array) -> float:
        return float((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]))

    return side(a, b, c) * side(a, b, d) <= 0 and side(c, d, a) * side(c, d, b) <= 0


_floors: list[Places] = []


def replaced_floor() -> Places:
    """Any floor: nothing is measured in this test."""
    if not _floors:
        empty = np.zeros(0)
        _floors.append(Places(
            "vector", np.ones(3), np.zeros(5, dtype=np.float32), np.zeros((1, 3)), np.array([[0, 1, 1]]),
            np.array([[0, 1]]), np.ones(1), np.ones(1), np.ones(1), np.ones(1), np.ones(5), empty, empty, 1.0,
            STRUCTURE,
        ))  # fmt: skip
    return _floors[0]
