"""Reductions of a field: what they keep, which maps answer which windows, and their variances against sampling."""

import numpy as np
import pytest

from app.errors import IncompatibleFrames
from app.positioning.features import common_components, field_jacobian, reduce_field, reduce_variance, window_features
from app.positioning.window import Window


@pytest.mark.parametrize("target", ["level", "norm", "vector"])
def test_first_order_variance_agrees_with_sampling(target: str) -> None:
    rng = np.random.default_rng(0)
    mean, sd = np.array([17.0, -9.0, -41.0]), np.array([0.3, 0.6, 0.9])
    drawn = reduce_field(mean + sd * rng.normal(size=(200_000, 3)), "vector", target)
    np.testing.assert_allclose(reduce_variance(mean, sd**2, "vector", target), drawn.var(axis=0), rtol=0.02)


@pytest.mark.parametrize(("source", "target"), [("vector", "level"), ("vector", "norm"), ("level", "norm")])
def test_jacobian_is_the_derivative(source: str, target: str) -> None:
    mean = np.array([17.0, -9.0, -41.0])[: 3 if source == "vector" else 2]
    numeric = np.stack(
        [
            (reduce_field(mean + step, source, target) - reduce_field(mean - step, source, target)) / 2e-6
            for step in 1e-6 * np.eye(len(mean))
        ],
        axis=-1,
    )
    np.testing.assert_allclose(field_jacobian(mean, source, target), numeric, atol=1e-6)


def test_level_then_norm_is_norm() -> None:
    field = np.random.default_rng(1).normal(size=(10, 3)) * 30
    level = reduce_field(field, "vector", "level")
    np.testing.assert_allclose(reduce_field(level, "level", "norm"), reduce_field(field, "vector", "norm"))


def test_a_field_of_zero_still_has_a_variance() -> None:
    assert reduce_variance(np.zeros(3), np.ones(3), "vector", "norm") == pytest.approx([1.0])


def test_one_poor_map_decides_for_all() -> None:
    assert common_components("level", {"a": "vector"}) == "vector"
    assert common_components("level", {"a": "vector", "b": "level"}) == "level"
    assert common_components("norm", {"a": "vector", "b": "level"}) == "norm"


@pytest.mark.parametrize("frame", ["level", "building"])
def test_a_norm_map_answers_norm_windows_only(frame: str) -> None:
    with pytest.raises(IncompatibleFrames, match="floor b"):
        common_components(frame, {"a": "vector", "b": "norm"})  # type: ignore[arg-type]


def test_window_features() -> None:
    B = np.array([[3.0, 4.0, -12.0]])
    window = Window("level", B, np.zeros((1, 3)), 0.1)
    np.testing.assert_allclose(window_features(window, "level"), [[5.0, -12.0]])
    np.testing.assert_allclose(window_features(window, "norm"), [[13.0]])
    np.testing.assert_allclose(window_features(Window("norm", B[:, :1], np.zeros((1, 3)), 0.1), "norm"), [[3.0]])
