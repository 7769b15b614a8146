"""The hypothesis that the map knows nothing of where the device is, told reading after reading.

The field is then a constant, about which nothing is known but the Earth's strength, plus a smooth process of the map's
own variance and steepness, under the errors of a typical place of the map (as `app.positioning.off_map` has it for
windows). How much better the particles predict the readings than this hypothesis does is the evidence that they follow
the device.
"""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array
from app.tracking.places import Places

__all__ = ["NoMap", "predict_without_map", "without_map"]


@dataclass(frozen=True, slots=True, eq=False)
class NoMap:
    """Per component: means (c, 3) of constant, walk noise and field (of unit variance), and covariances (c, 3, 3)."""

    mean: Array
    covariance: Array


def without_map(places: Places, offset_variance_uT2: float) -> NoMap:
    """Before the first reading: a vector's horizontal direction is not known."""
    c = len(places.scale)
    mean, covariance = np.zeros((c, 3)), np.tile(np.eye(3), (c, 1, 1))
    mean[:, 0] = places.ambient_uT
    covariance[:, 0, 0] = offset_variance_uT2
    if c == 3:
        mean[:2, 0] = 0.0
        covariance[:2, 0, 0] += 0.5 * float(np.sum(np.square(places.ambient_uT[:2])))
    return NoMap(mean, covariance)


def predict_without_map(
    nothing: NoMap, features_uT: Array, distance_m: float, noise_uT2: float, places: Places
) -> tuple[NoMap, float]:
    """After a reading (c,), and its log density beforehand."""
    fade = np.exp(-distance_m * np.array([0.0, places.errors[2], places.errors[4]]))
    mean = nothing.mean * fade
    covariance = nothing.covariance * np.outer(fade, fade)
    covariance += np.diag(1.0 - np.square(fade))
    walk_sd_uT = np.full(len(mean), np.sqrt(places.errors[0] * places.typical_variance_uT2))
    measure = np.stack([np.ones(len(mean)), walk_sd_uT, np.sqrt(places.prior_variance_uT2)], axis=1)
    innovation = features_uT - np.sum(measure * mean, axis=1)
    to = np.einsum("cij,cj->ci", covariance, measure)
    white = places.errors[1] * places.typical_variance_uT2 + noise_uT2
    total = np.sum(to * measure, axis=1) + white
    gain = to / total[:, None]
    log_density = -0.5 * float(np.sum(np.square(innovation) / total + np.log(2.0 * np.pi * total)))
    return NoMap(mean + gain * innovation[:, None], covariance - gain[:, :, None] * to[:, None, :]), log_density
