"""What a window and a map can be compared on: vector, (horizontal, vertical) or norm, with first-order variances.

A richer field is reduced by its Jacobian J: means by the function itself, variances by sum_c J_c^2 var_c, gradients by
J grad. For the norm this is Kuevor B12 (Kuevor, L859), with the variance the seed leaves open.
"""

import numpy as np

from app.errors import Fault, IncompatibleFrames
from app.field.samples import Components
from app.geometry import Array, horizontal_and_vertical
from app.positioning.window import Window, WindowFrame

__all__ = ["common_components", "field_jacobian", "reduce_field", "reduce_variance", "window_features"]

_RICHNESS: tuple[Components, ...] = ("norm", "level", "vector")
_WINDOW_GIVES: dict[WindowFrame, Components] = {"building": "vector", "level": "vector", "norm": "norm"}
_MAP_ANSWERS: dict[Components, tuple[WindowFrame, ...]] = {
    "vector": ("building", "level", "norm"),
    "level": ("building", "level", "norm"),
    "norm": ("norm",),
}


def common_components(frame: WindowFrame, maps: dict[str, Components]) -> Components:
    """The richest components that the window's frame and every map (by floor id) share.

    Likelihoods of different floors are only comparable on the same features, so one poor map reduces them all.
    Raises IncompatibleFrames when a map cannot answer this frame.
    """
    faults = [
        Fault(f"/floor_ids/{floor_id}", f"its map holds {components} components, which answer only norm windows")
        for floor_id, components in maps.items()
        if frame not in _MAP_ANSWERS[components]
    ]
    if faults:
        raise IncompatibleFrames(
            f"a window in the {frame} frame cannot be matched with the map of floor {faults[0].location[11:]}; send a "
            "norm window, or build that map with richer components",
            *faults,
        )
    shared = [_WINDOW_GIVES[frame], *maps.values()]
    return min(shared, key=_RICHNESS.index)


def window_features(window: Window, components: Components) -> Array:
    """The window's samples as features (n, c), uT, in the window's own frame (a vector still has to be turned)."""
    if components == "vector" or window.frame == "norm":
        return np.asarray(window.B_uT, dtype=np.float64).reshape(len(window.B_uT), -1)
    if components == "level":
        return horizontal_and_vertical(window.B_uT)
    return np.asarray(np.linalg.norm(window.B_uT, axis=1, keepdims=True))


def reduce_field(mean_uT: Array, source: Components, target: Components) -> Array:
    """Field means (..., c_source) as features (..., c_target), uT."""
    if source == target:
        return mean_uT
    if target == "norm":
        return np.asarray(np.linalg.norm(mean_uT, axis=-1, keepdims=True))
    return horizontal_and_vertical(mean_uT)


def field_jacobian(mean_uT: Array, source: Components, target: Components) -> Array:
    """Derivative of the features with the field, (..., c_target, c_source). A zero field takes equal shares."""
    c = mean_uT.shape[-1]
    if source == target:
        return np.broadcast_to(np.eye(c), (*mean_uT.shape[:-1], c, c))
    if target == "norm":
        return _unit(mean_uT)[..., None, :]
    jacobian = np.zeros((*mean_uT.shape[:-1], 2, 3))
    jacobian[..., 0, :2] = _unit(mean_uT[..., :2])
    jacobian[..., 1, 2] = 1.0
    return jacobian


def reduce_variance(mean_uT: Array, variance_uT2: Array, source: Components, target: Components) -> Array:
    """First-order variances (..., c_target) of the features, uT^2."""
    if source == target:
        return variance_uT2
    squared = np.square(field_jacobian(mean_uT, source, target))
    return np.asarray(np.einsum("...tc,...c->...t", squared, np.broadcast_to(variance_uT2, mean_uT.shape)))


def _unit(v: Array) -> Array:
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.asarray(np.where(length > 1e-9, v / np.maximum(length, 1e-9), 1.0 / np.sqrt(v.shape[-1])))
