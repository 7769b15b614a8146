"""A walk's samples as the observations a map is fitted from: averaged over short stretches of the path.

Averaging loses nothing (a field hardly bends over 20 cm) and makes a phone that stands still for a minute one
observation instead of three thousand: errors at one place are one error, not many.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.errors import InvalidInput
from app.field.samples import Components, Samples
from app.geometry import Array

__all__ = ["STRETCH_M", "Walk", "count_observations", "observe", "walk_bounds"]

STRETCH_M = 0.2
MIN_OBSERVATIONS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """The observations of one survey, in order of the walk.

    position_m      (n, 3) mean position of each stretch, building frame
    field_uT        (n, c) mean features of each stretch
    path_m          (n,) distance walked
    scatter_uT2     (c,) mean variance of single samples about the mean of their stretch
    sample_field_uT     (N, c) the features of the samples themselves
    stretch_of_sample   (N,) the observation each sample went into
    """

    survey_id: str
    position_m: Array
    field_uT: Array
    path_m: Array
    scatter_uT2: Array
    sample_field_uT: Array
    stretch_of_sample: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.position_m)


def observe(walks: Mapping[str, Samples], components: Components, stretch_m: float = STRETCH_M) -> list[Walk]:
    """The walks in order of survey id, each averaged over stretches of `stretch_m`.

    Raises IncompatibleFrames when a walk cannot give the components, InvalidInput when there is too little to fit.
    """
    observed = [_average(name, walks[name], components, stretch_m) for name in sorted(walks) if len(walks[name])]
    count = sum(len(walk) for walk in observed)
    if count < MIN_OBSERVATIONS:
        raise InvalidInput(
            f"the surveys cover {count} distinct places {stretch_m:g} m apart; a map needs at least "
            f"{MIN_OBSERVATIONS}: upload longer walks"
        )
    return observed


def count_observations(samples: Samples, stretch_m: float = STRETCH_M) -> int:
    """How many observations a walk becomes."""
    return len(_stretch_starts(samples.p_building_m, stretch_m)) if len(samples) else 0


def walk_bounds(walks: Sequence[Walk]) -> list[int]:
    """Where each walk begins, and the last one ends, when their observations are laid one after the other."""
    return [0, *accumulate(map(len, walks))]


def _average(survey_id: str, samples: Samples, components: Components, stretch_m: float) -> Walk:
    field_uT, position = samples.features(components), samples.p_building_m
    starts = _stretch_starts(position, stretch_m)
    position_m, mean_uT, scatter_uT2, stretch_of_sample = _means(position, field_uT, np.append(starts, len(samples)))
    if not (np.isfinite(mean_uT).all() and np.isfinite(position_m).all()):
        raise InvalidInput(f"survey {survey_id} has samples that are not finite numbers: remove them and upload again")
    steps = np.linalg.norm(np.diff(position_m[:, :2], axis=0), axis=1)
    path_m = np.concatenate([[0.0], np.cumsum(steps)])
    return Walk(survey_id, position_m, mean_uT, path_m, scatter_uT2, field_uT, stretch_of_sample)


@njit(cache=True)
def _means(
    position_m: Array, field_uT: Array, bounds: NDArray[np.int64]
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Position (n, 3) and field (n, c) averaged between bounds (n + 1,), mean variance (c,) about that, and the stretch

    (N,) of every sample.
    """
    stretches, components = len(bounds) - 1, field_uT.shape[1]
    place, mean = np.zeros((stretches, 3)), np.zeros((stretches, components))
    scatter, stretch_of_sample = np.zeros(components), np.empty(len(field_uT), dtype=np.int64)
    for stretch in range(stretches):
        first, last = bounds[stretch], bounds[stretch + 1]
        for i in range(first, last):
            stretch_of_sample[i] = stretch
            for axis in range(3):
                place[stretch, axis] += position_m[i, axis]
            for c in range(components):
                mean[stretch, c] += field_uT[i, c]
        place[stretch] /= last - first
        mean[stretch] /= last - first
        for i in range(first, last):
            for c in range(components):
                scatter[c] += (field_uT[i, c] - mean[stretch, c]) ** 2
    return place, mean, scatter / len(field_uT), stretch_of_sample


@njit(cache=True)
def _stretch_starts(position_m: Array, stretch_m: float) -> NDArray[np.int64]:
    """A new stretch begins where the walk is `stretch_m` away from where the present one began."""
    starts = np.zeros(len(position_m), dtype=np.int64)
    count, first = 1, 0
    for index in range(len(position_m)):
        squared = 0.0
        for axis in range(3):
            squared += (position_m[index, axis] - position_m[first, axis]) ** 2
        if squared >= stretch_m**2:
            starts[count], first = index, index
            count += 1
    return starts[:count]
