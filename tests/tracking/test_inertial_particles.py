"""Marginalised particles: against a Kalman filter where that is exact, against their twin, and in rooms."""

from dataclasses import replace

import numpy as np
import pytest

from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.tracking.constraints import Box
from app.tracking.field_likelihood import literal
from app.tracking.field_lookup import look_up
from app.tracking.inertial_particles import (
    InertialModel,
    InertialParticles,
    burst_of,
    error_variances,
    estimate_of,
    inertial_map,
    move,
    new_particles,
    step,
    weigh,
)
from app.tracking.inertial_particles_plain import move_and_weigh_plain
from app.tracking.motion import Accelerometer
from app.tracking.particle_filter import Particles, normalise, update

STEP_S, BURST = 0.005, 10
SLOPES = np.array([[8.0, 2.0, -1.0], [2.0, -5.0, 3.0], [-1.0, 3.0, -3.0]])
STRUCTURE = ErrorStructure(0.3, 0.4, 0.3, 1.5)


def grid_of(field, slopes, map_sd_uT=0.1, structure=STRUCTURE, resolution_m=0.25, reach_m=3.0):
    """A cube of side 2 reach about the origin, all of it mapped."""
    line = np.arange(-reach_m, reach_m + 1e-9, resolution_m)
    z, y, x = np.meshgrid(line, line, line, indexing="ij")
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    shape = (*x.shape, 3)
    return FieldGrid(
        components="vector", origin_m=(-reach_m, -reach_m), resolution_m=resolution_m, heights_m=line,
        mean_uT=field(points).reshape(shape).astype(np.float32), sd_uT=np.full(shape, map_sd_uT, dtype=np.float32),
        gradient_uT_per_m=np.broadcast_to(slopes, (*shape, 3)).astype(np.float32),
        measured=np.ones(x.shape, dtype=np.bool_), ambient_uT=np.zeros(3), prior_sd_uT=np.full(3, 5.0),
        noise_sd_uT=np.full(3, 0.2), error_structure=structure,
    )  # fmt: skip


@pytest.fixture
def linear():
    return grid_of(lambda p: p @ SLOPES.T, SLOPES)


@pytest.fixture
def bumpy():
    """A smooth field with a gradient of 3 to 15 uT/m everywhere: no place looks like one nearby."""
    waves = np.random.default_rng(3).normal(size=(6, 3))
    phases, turns = np.linspace(0.0, 5.0, 6), np.random.default_rng(4).normal(size=(6, 3))
    return grid_of(lambda p: 3.0 * np.sin(p @ waves.T + phases) @ turns, np.zeros((3, 3)), resolution_m=0.125)


def flight(grid, model, rng, steps, offset_sd_uT=None):
    """Positions (m, 3), bursts and readings of a device about the origin, errors drawn from the filter's own model."""
    t_s = STEP_S * np.arange(steps * BURST + 2)
    rate, phase = rng.uniform(0.5, 1.5, (2, 3)), rng.uniform(0.0, 6.0, 3)
    path = 0.6 * np.sin(rate[0] * t_s[:, None] + phase)
    velocity = np.diff(path, axis=0) / STEP_S
    noise = model.acceleration_m_s2 * rng.normal(size=(steps * BURST, 3)) + model.bias_m_s2 * rng.normal(size=3)
    true = path[1 + BURST :: BURST]
    the_map, shares = inertial_map(grid), grid.error_structure
    looked = look_up(the_map.table, true)
    walk_uT2, white_uT2 = error_variances(looked.variance_uT2.mean(axis=1), the_map, model)
    constant = np.hypot(model.offset_uT, np.sqrt(shares.constant_share * the_map.typical_uT2)) * rng.normal(size=3)
    walk = rng.normal(size=3)
    readings = np.empty_like(true)
    for k in range(len(true)):
        fade = np.exp(-np.linalg.norm(true[k] - true[k - 1]) / shares.walk_length_m) if k else 1.0
        walk = fade * walk + np.sqrt(1.0 - fade**2) * rng.normal(size=3)
        white = np.sqrt(white_uT2) * rng.normal(size=3)
        readings[k] = looked.mean_uT[k] + constant + np.sqrt(walk_uT2[k]) * walk + white
    bursts = (np.diff(velocity, axis=0) / STEP_S + noise).reshape(steps, BURST, 3)
    return path[1], velocity[0], true, bursts, readings


def fly(grid, flown, model, n, seed, **options):
    """Stepped of every reading, from a prior of 5 cm and 5 cm/s."""
    at, velocity, _, bursts, readings = flown
    rng, the_map = np.random.default_rng(seed), inertial_map(grid)
    start, speed = at + 0.05 * rng.normal(size=3), velocity + 0.05 * rng.normal(size=3)
    particles, found = new_particles(start + 0.05 * rng.normal(size=(n, 3)), speed, 0.05, model, the_map), []
    for burst, reading in zip(bursts, readings, strict=True):
        told = burst_of(burst, STEP_S, model)
        found.append(step(particles, told, reading, the_map, model, rng, **options))
        particles = found[-1].particles
    return found


class TestTwin:
    def test_rows_and_weights_are_those_of_one_large_filter_each(self, bumpy):
        measured = bumpy.measured.copy()
        measured[:, :, :20] = False
        grid, rng, model = replace(bumpy, measured=measured), np.random.default_rng(1), InertialModel()
        the_map = inertial_map(grid)
        fast = plain = new_particles(rng.uniform(-1.5, 1.5, (30, 3)), np.array([0.3, -0.2, 0.1]), 0.2, model, the_map)
        for _ in range(6):
            burst, reading = rng.normal(size=(BURST, 3)), rng.normal(size=3)
            noise = rng.normal(size=(30, 3))
            plain = move_and_weigh_plain(plain, burst, STEP_S, noise, reading, grid, the_map, model)
            fast = weigh(move(fast, burst_of(burst, STEP_S, model), noise), fast.rows[:, :3], reading, the_map, model)
            np.testing.assert_allclose(fast.rows, plain.rows, rtol=1e-7, atol=1e-9)
            np.testing.assert_allclose(fast.log_weight, plain.log_weight, rtol=1e-7)
            np.testing.assert_allclose(fast.inertial, plain.inertial, rtol=1e-9, atol=1e-15)

    def test_one_burst_is_as_many_steps(self):
        """Without what is known by the path, sums of bursts are those of their steps."""
        rng, model = np.random.default_rng(2), InertialModel()
        burst = rng.normal(size=(BURST, 3))
        whole, single = burst_of(burst, STEP_S, model), [burst_of(each[None], STEP_S, model) for each in burst]
        p, v = np.zeros((2, 3))
        for each in single:
            p, v = p + each.lever[0] * v + each.moved_m, v + each.gained_m_s
        np.testing.assert_allclose(whole.gained_m_s, v)
        np.testing.assert_allclose(whole.moved_m, p)


class TestKalman:
    def test_mean_and_covariance_on_a_linear_field(self, linear):
        """All is linear there but the way between readings, so there is no walk noise this once."""
        structure, model = ErrorStructure(0.3, 0.0, 0.7, 1.0), InertialModel(position_m_per_sqrt_s=0.05)
        grid = replace(linear, error_structure=structure, sd_uT=np.full_like(linear.sd_uT, 1e-4))
        at, velocity, _, bursts, readings = flown = flight(grid, model, np.random.default_rng(3), 30)
        the_map, variance = inertial_map(grid), 0.2**2
        mean = np.concatenate([at, velocity, np.zeros(6)])
        offset = model.offset_uT**2 + 0.3 * variance
        P = np.kron(np.diag([0.05**2, 0.05**2, model.bias_m_s2**2, offset]), np.eye(3))
        one, o = np.eye(3), np.zeros((3, 3))
        H, R = np.hstack([SLOPES, o, o, one]), (0.7 * variance + model.reading_uT**2) * one
        rng = np.random.default_rng(4)
        n = 30_000
        particles = new_particles(at + 0.05 * rng.normal(size=(n, 3)), velocity, 0.05, model, the_map)
        for burst, reading in zip(bursts, readings, strict=True):
            told = burst_of(burst, STEP_S, model)
            F = np.eye(12)
            F[:3, 3:6], F[:3, 6:9], F[3:6, 6:9] = told.lever[0] * one, told.lever[1] * one, told.transition[0, 1] * one
            mean = F @ mean + np.concatenate([told.moved_m, told.gained_m_s, np.zeros(6)])
            P = F @ P @ F.T
            P[:6, :6] += np.kron(told.noise, one)
            gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            mean, P = mean + gain @ (reading - H @ mean), P - gain @ H @ P
            found = step(particles, told, reading, the_map, model, rng)
            particles = found.particles
        sd = np.sqrt(np.diag(P))
        assert np.all(np.abs(found.estimate.mean - mean) < 0.2 * sd)
        np.testing.assert_allclose(np.sqrt(np.diag(found.estimate.covariance)), sd, rtol=0.2)
        correlation = found.estimate.covariance / np.outer(sd, sd)
        np.testing.assert_allclose(correlation, P / np.outer(sd, sd), atol=0.3)
        assert len(flown) == 5


class TestConsistency:
    def test_nees_of_flights_of_the_filters_own_model(self, bumpy):
        """Three degrees of freedom; half of what is expected to three times it: 400 particles are few."""
        model, nees = InertialModel(position_m_per_sqrt_s=0.014), []
        for seed in range(8):
            flown = flight(bumpy, model, np.random.default_rng(seed), 100)
            for stepped, true in list(zip(fly(bumpy, flown, model, 400, seed), flown[2], strict=True))[20::20]:
                off = stepped.estimate.mean[:3] - true
                nees.append(off @ np.linalg.solve(stepped.estimate.covariance[:3, :3], off))
        assert 0.5 < np.mean(nees) / 3.0 < 3.0, np.mean(nees)

    def test_a_hovering_device_does_not_grow_certain_by_reading_on(self, linear):
        """Its readings share one error of the map: over 200 readings the offset stays as open as the walk noise."""
        model = InertialModel(acceleration_m_s2=1e-3, bias_m_s2=1e-6, position_m_per_sqrt_s=1e-6)
        the_map, rng = inertial_map(linear), np.random.default_rng(5)
        particles = new_particles(np.zeros((1, 3)), np.zeros(3), 1e-6, model, the_map)
        for _ in range(200):
            still = burst_of(np.zeros((BURST, 3)), STEP_S, model)
            particles = step(particles, still, np.zeros(3), the_map, model, rng).particles
        own = model.offset_uT**2 + 0.3 * the_map.typical_uT2
        walk = 0.4 * the_map.typical_uT2
        assert particles.rows[0, 15] == pytest.approx(own * walk / (own + walk), rel=0.1)


class TestRooms:
    def test_beats_the_bootstrap_filter_with_as_many_particles(self, bumpy):
        model, n = InertialModel(), 300
        ours, literal_rms = [], []
        for seed in range(4):
            flown = flight(bumpy, model, np.random.default_rng(100 + seed), 120)
            found = np.array([each.estimate.mean[:3] for each in fly(bumpy, flown, model, n, seed)])
            ours.append(np.sqrt(np.mean(np.square(found - flown[2]))))
            literal_rms.append(np.sqrt(np.mean(np.square(bootstrap(bumpy, flown, n, seed) - flown[2]))))
        assert np.mean(ours) < 0.8 * np.mean(literal_rms), (ours, literal_rms)

    def test_altimeter_and_box(self, linear):
        model = InertialModel()
        flown = flight(linear, model, np.random.default_rng(6), 20)
        box = Box(np.full(3, -2.0), np.full(3, 2.0))
        told = fly(linear, flown, model, 200, 0, height_m=float(flown[2][-1, 2]), box=box)
        assert not any(each.all_outside or each.diverged for each in told)
        assert told[-1].estimate.covariance[2, 2] < 0.005
        away = replace(told[-1].particles, rows=told[-1].particles.rows + np.eye(18)[0] * 5.0)
        burst = burst_of(np.zeros((BURST, 3)), STEP_S, model)
        back = step(away, burst, np.zeros(3), inertial_map(linear), model, np.random.default_rng(0), box=box)
        assert back.all_outside
        np.testing.assert_allclose(back.particles.rows[:, 0], 1.75)
        np.testing.assert_array_equal(back.particles.rows[:, 3], 0.0)

    def test_all_lost_is_a_divergence_and_no_nan(self, linear):
        model, the_map = InertialModel(), inertial_map(linear)
        particles = new_particles(np.zeros((5, 3)), np.zeros(3), 0.1, model, the_map)
        lost = InertialParticles(particles.rows, np.full(5, -np.inf), particles.inertial)
        burst = burst_of(np.zeros((BURST, 3)), STEP_S, model)
        found = step(lost, burst, np.zeros(3), the_map, model, np.random.default_rng(0))
        assert found.diverged
        assert not found.resampled
        assert np.isfinite(found.estimate.mean).all()
        np.testing.assert_allclose(normalise(found.particles.log_weight).weight, 0.2)

    def test_the_same_seed_gives_the_same_bits(self, linear):
        model = InertialModel()
        flown = flight(linear, model, np.random.default_rng(7), 10)
        one, two = (fly(linear, flown, model, 50, 3)[-1].particles for _ in range(2))
        np.testing.assert_array_equal(one.rows, two.rows)

    def test_estimate_holds_what_each_particle_does_not_know(self, linear):
        model, the_map = InertialModel(), inertial_map(linear)
        particles = new_particles(np.zeros((4, 3)), np.ones(3), 0.3, model, the_map)
        found = estimate_of(particles, np.full(4, 0.25))
        np.testing.assert_allclose(found.covariance[3:6, 3:6], 0.09 * np.eye(3))
        np.testing.assert_allclose(np.diag(found.covariance)[9:], 0.25**2 + 0.3 * the_map.typical_uT2)


def bootstrap(grid, flown, n, seed):
    """The source's filter with the proposed values, (m, 3)."""
    at, velocity, _, bursts, readings = flown
    rng, table, motion = np.random.default_rng(seed), inertial_map(grid).table, Accelerometer()
    start = np.concatenate([at, velocity]) + 0.05 * rng.normal(size=6)
    particles, means = Particles.equal(start + 0.05 * rng.normal(size=(n, 6))), []
    for burst, reading in zip(bursts, readings, strict=True):
        state = motion.propagate_burst(particles.state, burst, STEP_S, rng)
        log_l = literal(look_up(table, state[:, :3]), reading, 1.0)
        jitter = np.repeat([0.02, 0.05], 3)
        found = update(Particles(state, particles.log_weight), log_l, rng, jitter_sd=jitter)
        particles = found.particles
        means.append(found.estimate.mean[:3])
    return np.array(means)
