"""What a window does not tell by itself: the sensor's offset, step scale and heading drift; and how far to walk."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from app.field.grid import FieldGrid
from app.geometry import yaw_matrix
from app.positioning.fix import LocateOptions
from app.positioning.floors import prepare_floor
from app.positioning.lattice import course_lattice, lattice_noise_uT2, reduce_window, widest_steps
from app.positioning.locate import locate, locate_and_explain
from app.positioning.window import Window, course_yaw_rad


@pytest.fixture(scope="module")
def world() -> FieldGrid:
    from tests.positioning.conftest import make_grid

    return make_grid(np.random.default_rng(1), (100, 120), length_m=1.6)


def test_an_offset_of_a_device_that_turns_is_integrated_out(world: FieldGrid) -> None:
    """A right angle walked with ten microtesla of hard iron: constant in the body, not in the building."""
    rng = np.random.default_rng(2)
    leg = np.arange(0.0, 4.01, 0.25)
    p = np.concatenate([np.column_stack([leg, 0 * leg]), np.column_stack([4.0 + 0 * leg[1:], leg[1:]])])
    p = p + np.array([4.0, 12.0])
    yaw = np.concatenate([np.zeros(len(leg)), np.full(len(leg) - 1, np.pi / 2)])
    truth = world.at(p).mean_uT
    body = np.array([yaw_matrix(-a) @ B for a, B in zip(yaw, truth, strict=True)]) + np.array([8.0, -5.0, 4.0])
    B = np.array([yaw_matrix(a) @ b for a, b in zip(yaw, body, strict=True)]) + rng.normal(0.0, 0.4, truth.shape)
    level = Window("level", B, np.column_stack([p - p[0], np.zeros(len(p))]), 0.4, yaw_rad=yaw)
    rotations = np.array([yaw_matrix(a) for a in yaw])
    in_building = dataclasses.replace(level, frame="building", yaw_rad=None, device_to_frame=rotations)
    for window in (level, in_building):
        for asked in ({"composition": "demeaned"}, {"options": LocateOptions(bias_sd_uT=10.0)}):
            fix, why = locate_and_explain(window, [prepare_floor("a", world)], **asked)
            assert fix.status == "fix", fix.reason
            assert fix.ml is not None
            assert np.linalg.norm(np.array(fix.ml.position_m[:2]) - p[-1]) < 0.3
            assert why is not None
            np.testing.assert_allclose(why.best.bias_uT, [8.0, -5.0, 4.0], atol=1.0)


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_a_wrong_step_length_is_found(scale: float, world: FieldGrid, walk_on: Callable) -> None:
    walked = walk_on(np.random.default_rng(3), world, length_m=15.0, samples=40)
    told = dataclasses.replace(walked.window, displacement_m=walked.window.displacement_m / scale)
    options = LocateOptions(step_scale_sd=0.07)
    fix, why = locate_and_explain(told, [prepare_floor("a", world)], options=options)
    assert why is not None
    assert why.best.step_scale == pytest.approx(scale, abs=0.02)
    assert np.linalg.norm(np.array(why.best.position_m[:2]) - walked.position_m) < 0.3
    assert fix.status == "fix"


def test_a_drifting_heading_is_found(world: FieldGrid, walk_on: Callable) -> None:
    """Told yaw and displacement turn away from the truth by 0.2 rad over 15 m."""
    walked = walk_on(np.random.default_rng(5), world, length_m=15.0, samples=40)
    w, n = walked.window, 40
    along = np.linspace(0.0, 15.0, n)
    gained = -0.2 / 15.0 * along
    steps = np.diff(w.displacement_m, axis=0)
    turned = np.array([yaw_matrix(g) @ s for g, s in zip(0.5 * (gained[1:] + gained[:-1]), steps, strict=True)])
    told = dataclasses.replace(
        w,
        displacement_m=np.concatenate([np.zeros((1, 3)), np.cumsum(turned, axis=0)]),
        B_uT=np.array([yaw_matrix(g) @ b for g, b in zip(gained, w.B_uT, strict=True)]),
        yaw_rad=w.yaw_rad + gained,
    )
    options = LocateOptions(heading_drift_sd_rad_per_m=0.01)
    fix, why = locate_and_explain(told, [prepare_floor("a", world)], options=options)
    assert why is not None
    assert why.best.heading_drift_rad_per_m == pytest.approx(0.2 / 15.0, abs=0.003)
    assert fix.ml is not None
    assert np.linalg.norm(np.array(fix.ml.position_m[:2]) - walked.position_m) < 0.3
    assert fix.ml.heading_rad is not None
    assert abs(np.angle(np.exp(1j * (fix.ml.heading_rad - walked.heading_rad)))) < 0.05


def test_the_lattice_covers_the_priors_and_adds_what_lies_between(world: FieldGrid, walk_on: Callable) -> None:
    walked = walk_on(np.random.default_rng(6), world, length_m=12.0, samples=30)
    window = reduce_window(walked.window, "vector", 0.25)
    steps = widest_steps(window, 5.0, np.full(len(window), 0.3), None)
    courses = course_lattice(walked.window, steps, 0.08, 0.02)
    scales, drifts = np.unique(courses.scale), np.unique(courses.drift_rad_per_m)
    assert 1.17 < scales.max() < 1.25
    assert len(scales) % 2 == len(drifts) % 2 == 1
    assert np.exp(courses.log_prior).sum() == pytest.approx(len(np.unique(courses.heading_rad)))
    between = lattice_noise_uT2(window, 5.0, courses.steps)
    assert (between > 0.0).all()
    middle, end = np.argmin(np.abs(window.path_m - 6.0)), len(window) - 1
    assert between[end] > between[middle], "the ends of the window move most between two courses"
    single = course_lattice(dataclasses.replace(walked.window, heading_rad=0.0), steps, 0.0, 0.0)
    assert len(single) == 1
    np.testing.assert_array_equal(lattice_noise_uT2(window, 5.0, single.steps), 0.0)


def test_a_course_turns_with_its_path() -> None:
    angle = np.linspace(0.0, np.pi / 2, 60)
    arc = 5.0 * np.column_stack([np.sin(angle), 1.0 - np.cos(angle)])
    yaw = course_yaw_rad(arc)
    np.testing.assert_allclose(yaw[5:-5] - yaw[30], angle[5:-5] - angle[30], atol=0.02)
    stood = np.repeat(arc, 4, axis=0)
    np.testing.assert_allclose(course_yaw_rad(stood)[::4], yaw, atol=1e-9)
    assert (course_yaw_rad(0.01 * arc) == 0.0).all()


def test_an_ambiguous_window_says_how_far_to_walk(grid_of: Callable, walk_on: Callable) -> None:
    """The same ten metres twice, then ground of its own: walking on over the seam tells which."""
    rng = np.random.default_rng(8)
    half, own = grid_of(rng, (40, 40)), grid_of(rng, (40, 40))
    names = ("mean_uT", "sd_uT", "gradient_uT_per_m", "measured")
    parts = {name: np.concatenate([getattr(half, name), getattr(half, name), getattr(own, name)], axis=2)
             for name in names}  # fmt: skip
    grid = dataclasses.replace(half, **parts)
    p = np.column_stack([np.linspace(2.0, 6.0, 17), np.full(17, 12.0)])
    B = half.at(p).mean_uT + rng.normal(0.0, 0.3, (17, 3))
    window = Window("building", B, np.column_stack([p - p[0], np.zeros(17)]), 0.3)
    fix = locate(window, [prepare_floor("a", grid)])
    assert fix.status == "ambiguous"
    assert fix.reason is not None
    assert "one other place is" in fix.reason
    assert "(the nearest 10 m away)" in fix.reason
    distance = int(fix.reason.split("about ")[1].split(" m straight")[0])
    assert 1 <= distance <= 8, "the copies part where the first ends, one to seven metres on"


def test_a_misfit_is_named(world: FieldGrid, walk_on: Callable) -> None:
    """A passing trolley disturbs two metres of a walk that is otherwise well known."""
    from app.positioning.fix import Prior

    walked = walk_on(np.random.default_rng(9), world, length_m=10.0, samples=41)
    B = walked.window.B_uT.copy()
    B[16:22] += np.array([0.0, 0.0, 14.0]) * np.where(np.arange(6) % 2, -1.0, 1.0)[:, None]
    narrow = dataclasses.replace(world, prior_sd_uT=np.full(3, 1.0))
    window = dataclasses.replace(walked.window, B_uT=B, heading_rad=walked.yaw_rad, heading_sd_rad=0.05)
    fix = locate(window, [prepare_floor("a", narrow)], prior=Prior((*walked.position_m, 1.2), 0.5))
    assert fix.status == "inconsistent", fix.reason
    assert fix.reason is not None
    assert "vertical" in fix.reason
    assert "along the walk" in fix.reason
