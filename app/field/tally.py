"""Sums over a survey's errors against the map of the others, in compiled loops: what its score and its reports need."""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["Tally", "count_below", "held_out_errors", "means_of_places", "standardised", "tally"]

Bools = NDArray[np.bool_]
Indices = NDArray[np.int64]


class Tally(NamedTuple):
    """Over runs of samples, of the judged ones: their number (r,), path of the first and the last (r, 2); and (r, c) of

    errors within two sds the number, of squared errors, of those in sds, of sds and of their logarithms the sums.
    """

    samples: Array
    path_m: Array
    within: Array
    squared_uT2: Array
    squared: Array
    sd_uT: Array
    log_sd: Array

    def whole(self) -> "Tally":
        """All runs as one; some sample must be judged."""
        first, last = np.flatnonzero(self.samples)[[0, -1]]
        ends_m = np.array([[self.path_m[first, 0], self.path_m[last, 1]]])
        samples, _, *sums = self
        return Tally(samples.sum(keepdims=True), ends_m, *(each.sum(axis=0, keepdims=True) for each in sums))

    def at(self, runs: Indices) -> "Tally":
        return Tally(*(each[runs] for each in self))

    @property
    def nlpd(self) -> float:
        """Mean negative log predictive density per sample and component, of the first run."""
        each = 0.5 * np.log(2.0 * np.pi) * self.samples[0] + self.log_sd[0] + 0.5 * self.squared[0]
        return float(each.mean() / self.samples[0])


def tally(error_uT: Array, sd_uT: Array, judged: Bools, path_m: Array, bounds: Indices) -> Tally:
    """Of the runs between bounds (r + 1,); errors and sds (n, c), judged and distance walked (n,)."""
    return Tally(*_tally(error_uT, sd_uT, judged, path_m, bounds))


@njit(cache=True)
def _tally(
    error_uT: Array, sd_uT: Array, judged: Bools, path_m: Array, bounds: Indices
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:
    runs, components = len(bounds) - 1, error_uT.shape[1]
    count, ends_m = np.zeros(runs), np.zeros((runs, 2))
    within, squared_uT2, squared, total_sd, log_sd = np.zeros((5, runs, components))
    product = np.ones(components)
    for run in range(runs):
        product[:] = 1.0
        for i in range(bounds[run], bounds[run + 1]):
            if not judged[i]:
                continue
            if count[run] == 0:
                ends_m[run, 0] = path_m[i]
            ends_m[run, 1] = path_m[i]
            count[run] += 1
            for c in range(components):
                error, sd = error_uT[i, c], sd_uT[i, c]
                z = error / sd
                within[run, c] += abs(z) <= 2.0
                squared_uT2[run, c] += error * error
                squared[run, c] += z * z
                total_sd[run, c] += sd
                product[c] *= sd  # one logarithm serves many factors
                if not 1e-100 < product[c] < 1e100:
                    log_sd[run, c] += np.log(product[c])
                    product[c] = 1.0
        log_sd[run] += np.log(product)
    return count, ends_m, within, squared_uT2, squared, total_sd, log_sd


@njit(cache=True)
def held_out_errors(
    field_uT: Array, predicted_uT: Array, latent_uT2: Array, place: Indices, judged: Bools
) -> tuple[Array, Array]:
    """Error (N, c) of samples whose prediction and its variance (n, c) stand at `place` (N,); and, of the judged ones,

    the noise variance (j, c) with which each would lie at two predictive sds.
    """
    error = np.empty(field_uT.shape)
    needed = np.empty((np.count_nonzero(judged), field_uT.shape[1]))
    row = 0
    for i in range(len(field_uT)):
        for c in range(field_uT.shape[1]):
            error[i, c] = field_uT[i, c] - predicted_uT[place[i], c]
            if judged[i]:
                needed[row, c] = error[i, c] ** 2 / 4.0 - latent_uT2[place[i], c]
        row += judged[i]
    return error, needed


@njit(cache=True)
def count_below(bound: float, error_uT: Array, sd_uT: Array, judged: Bools) -> Indices:
    """(c,) of the judged errors, how many are smaller than `bound` predictive sds."""
    count = np.zeros(error_uT.shape[1], dtype=np.int64)
    for i in range(len(judged)):
        if judged[i]:
            for c in range(len(count)):
                count[c] += abs(error_uT[i, c]) < bound * sd_uT[i, c]
    return count


@njit(cache=True)
def standardised(error_uT: Array, sd_uT: Array, judged: Bools) -> Array:
    """(j, c) errors of the judged samples in predictive sds."""
    values = np.empty((np.count_nonzero(judged), error_uT.shape[1]))
    row = 0
    for i in range(len(judged)):
        if judged[i]:
            for c in range(values.shape[1]):
                values[row, c] = error_uT[i, c] / sd_uT[i, c]
            row += 1
    return values


@njit(cache=True)
def means_of_places(values: Array, place: Indices, chosen: Bools, places: int) -> tuple[Array, Indices]:
    """(places, c) mean of the chosen values (n, c) at every place, NaN at those of none, and their number (places,)."""
    mean, count = np.zeros((places, values.shape[1])), np.zeros(places, dtype=np.int64)
    for i in range(len(values)):
        if chosen[i]:
            count[place[i]] += 1
            for c in range(values.shape[1]):
                mean[place[i], c] += values[i, c]
    for p in range(places):
        for c in range(values.shape[1]):
            mean[p, c] = mean[p, c] / count[p] if count[p] else np.nan
    return mean, count
