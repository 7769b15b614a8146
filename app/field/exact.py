"""The reference engine: exact Gaussian processes by scikit-learn, faithful to Kuevor's intermediate map (B7-B9).

One independent process per component over positions in three dimensions, isotropic kernel and white noise, each with
its own hyper-parameters by maximum marginal likelihood (Kuevor, L423-L451, L564-L568); about an ambient constant in
place of a zero mean. Costs grow with the cube of the observations, so their number is capped.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial.distance import cdist

from app.errors import InvalidInput
from app.field.estimate import FieldEstimate, ambient_field_uT
from app.field.hard_iron import Cleaned
from app.field.kernels import MATERN_SMOOTHNESS, base_kernel, covariance, covariance_slope, is_sum
from app.field.observations import Walk
from app.field.raster import GridFrame, layer_heights_m
from app.field.spec import BaseKernel, MapSpec, Progress
from app.field.tile_fit import FitState
from app.geometry import Array

__all__ = [
    "MAX_OBSERVATIONS",
    "Conditioned",
    "ExactPosterior",
    "ExactProcess",
    "Observations",
    "condition",
    "estimate_by_exact",
    "estimate_of",
    "learn_components",
    "learn_exact",
]

MAX_OBSERVATIONS = 2000
CELLS_AT_ONCE = 2000


@dataclass(frozen=True, slots=True, eq=False)
class ExactProcess:
    """One component's process: kernel, length, signal and noise sd."""

    kernel: BaseKernel
    length_m: float
    signal_sd_uT: float
    noise_sd_uT: float

    def condition(self, position_m: Array, deviation_uT: Array) -> "ExactPosterior":
        """Given features (n,) about the ambient field at positions (n, d)."""
        gram = self.signal_sd_uT**2 * covariance(self.kernel, _distances_m(position_m, position_m), self.length_m)
        gram[np.diag_indices_from(gram)] += self.noise_sd_uT**2
        factor = cho_factor(gram, lower=True, check_finite=False)
        return ExactPosterior(self, position_m, factor[0], cho_solve(factor, deviation_uT, check_finite=False))


@dataclass(frozen=True, slots=True, eq=False)
class ExactPosterior:
    """A process conditioned on observations (Rasmussen & Williams 2006, algorithm 2.1)."""

    process: ExactProcess
    position_m: Array
    factor: Array
    dual_uT: Array

    def at(self, points_m: Array) -> tuple[Array, Array]:
        """Mean (n,) about the ambient field and latent variance over the prior's (n,)."""
        prior = covariance(
            self.process.kernel, _distances_m(points_m, self.position_m), self.process.length_m
        ) * np.square(self.process.signal_sd_uT)
        explained = np.sum(np.square(solve_triangular(self.factor, prior.T, lower=True, check_finite=False)), axis=0)
        return prior @ self.dual_uT, np.maximum(1.0 - explained / self.process.signal_sd_uT**2, 0.0)

    def mean_at(self, points_m: Array) -> Array:
        """Mean (n,) about the ambient field, without the cost of the variance."""
        prior = covariance(self.process.kernel, _distances_m(points_m, self.position_m), self.process.length_m)
        return np.asarray(np.square(self.process.signal_sd_uT) * prior @ self.dual_uT)

    def gradient_at(self, points_m: Array) -> Array:
        """(n, 3) exact derivative of the mean with x, y and z, uT/m."""
        slope = covariance_slope(
            self.process.kernel, _distances_m(points_m, self.position_m), self.process.length_m
        ) * np.square(self.process.signal_sd_uT)
        weighted = slope * self.dual_uT
        return np.asarray(points_m * weighted.sum(axis=1, keepdims=True) - weighted @ self.position_m)


def learn_exact(kernel: BaseKernel, position_m: Array, deviation_uT: Array) -> ExactProcess:
    """Hyper-parameters of one component by scikit-learn's marginal likelihood (Kuevor B8).

    scikit-learn takes seconds to import and only this needs it, so it is imported here.
    """
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

    spread = max(float(np.std(deviation_uT)), 1e-3)
    limits_m = (0.1, 50.0)
    shape = RBF(1.0, limits_m) if kernel == "squared_exponential" else Matern(1.0, limits_m, MATERN_SMOOTHNESS[kernel])
    signal = ConstantKernel(spread**2, (1e-4 * spread**2, 1e4 * spread**2))
    white = WhiteKernel((0.1 * spread) ** 2, (1e-8 * spread**2, 10 * spread**2))
    regressor = GaussianProcessRegressor(signal * shape + white, alpha=0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a parameter at its bound: a flat field, not a failure
        regressor.fit(position_m, deviation_uT)
    log_signal, log_length, log_noise = regressor.kernel_.theta
    return ExactProcess(kernel, float(np.exp(log_length)), float(np.exp(log_signal / 2)), float(np.exp(log_noise / 2)))


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Positions (n, 3), features (n, c) about the ambient field (c,), and the index (n,) of the walk each is of."""

    position_m: Array
    deviation_uT: Array
    walk: NDArray[np.int64]
    ambient_uT: Array

    @classmethod
    def of(cls, walks: Sequence[Walk]) -> "Observations":
        ambient_uT = ambient_field_uT(walks)
        return cls(
            np.concatenate([walk.position_m for walk in walks]),
            np.concatenate([walk.field_uT for walk in walks]) - ambient_uT,
            np.repeat(np.arange(len(walks)), [len(walk) for walk in walks]),
            ambient_uT,
        )

    def __len__(self) -> int:
        return len(self.position_m)

    def __getitem__(self, chosen: NDArray[np.bool_] | NDArray[np.int64]) -> "Observations":
        return Observations(self.position_m[chosen], self.deviation_uT[chosen], self.walk[chosen], self.ambient_uT)


Conditioned = Callable[[Observations], list[ExactPosterior]]
"""The map of some observations: one posterior per component."""


def estimate_by_exact(
    walks: Sequence[Walk], cleaned: Cleaned, spec: MapSpec, previous: FitState | None, progress: Progress
) -> FieldEstimate:
    """The exact posterior of every component; surveys left out by honest refits at the same hyper-parameters.

    `cleaned` and `previous` are not made use of. Raises InvalidInput above MAX_OBSERVATIONS, and for a sum of kernels.
    """
    observations = Observations.of(walks)
    if len(observations) > MAX_OBSERVATIONS:
        raise InvalidInput(
            f"the exact engine takes at most {MAX_OBSERVATIONS} observations and the surveys have {len(observations)}: "
            "use engine compromise or hilbert"
        )
    processes = learn_components(spec, observations, progress)
    return estimate_of(walks, spec, observations, processes, lambda some: condition(processes, some), progress)


def learn_components(spec: MapSpec, observations: Observations, progress: Progress) -> list[ExactProcess]:
    """The process of every component, each with hyper-parameters of its own: the first half of a fit.

    Raises InvalidInput for a sum of kernels.
    """
    kernel = base_kernel(spec.covariance)
    if is_sum(spec.covariance):
        raise InvalidInput(
            f"the {spec.engine} engine has one length for a kernel: ask for {kernel}, or use engine hilbert"
        )
    targets = observations.deviation_uT.T
    processes = []
    for component, target in enumerate(targets):
        progress(0.5 * component / len(targets), f"learning component {component + 1} of {len(targets)}")
        processes.append(learn_exact(kernel, observations.position_m, target))
    return processes


def condition(processes: Sequence[ExactProcess], observations: Observations) -> list[ExactPosterior]:
    """The posterior of every component."""
    targets = observations.deviation_uT.T
    return [p.condition(observations.position_m, target) for p, target in zip(processes, targets, strict=True)]


def estimate_of(
    walks: Sequence[Walk],
    spec: MapSpec,
    observations: Observations,
    processes: Sequence[ExactProcess],
    conditioned: Conditioned,
    progress: Progress,
) -> FieldEstimate:
    """The field on the cells; every walk predicted by an honest refit without it, at the same hyper-parameters."""
    longest_m = max(p.length_m for p in processes)
    frame = GridFrame.around(walks, spec.resolution_m, longest_m, layer_heights_m(walks, spec))
    mean_uT, variance_ratio, gradient = _on_cells(conditioned(observations), frame, progress)
    held_out = {}
    for index, walk in enumerate(walks):
        progress(0.9 + 0.1 * index / len(walks), f"leaving out survey {index + 1} of {len(walks)}")
        held_out[walk.survey_id] = _predict(conditioned, observations[observations.walk != index], walk)
    return FieldEstimate(
        frame=frame,
        ambient_uT=observations.ambient_uT,
        mean_uT=mean_uT,
        variance_ratio=variance_ratio,
        gradient_uT_per_m=gradient,
        prior_sd_uT=np.array([p.signal_sd_uT for p in processes]),
        error_sd_uT=np.array([p.noise_sd_uT for p in processes]),
        held_out_mean_uT={name: mean for name, (mean, _) in held_out.items()},
        held_out_variance_ratio={name: variance for name, (_, variance) in held_out.items()},
        hyperparameters={
            "kernel": processes[0].kernel,
            "length_m": [p.length_m for p in processes],
            "signal_sd_ut": [p.signal_sd_uT for p in processes],
            "white_noise_sd_ut": [p.noise_sd_uT for p in processes],
        },
    )


def _on_cells(posteriors: Sequence[ExactPosterior], frame: GridFrame, progress: Progress) -> tuple[Array, Array, Array]:
    """Mean and variance ratio (c, nz, ny, nx), gradient (3, c, nz, ny, nx) at the cell centres, some at a time."""
    z_m, y_m, x_m = np.meshgrid(frame.heights_m, frame.y_m, frame.x_m, indexing="ij")
    centres_m = np.column_stack([x_m.ravel(), y_m.ravel(), z_m.ravel()])
    mean, variance = np.zeros((2, len(posteriors), len(centres_m)))
    gradient = np.zeros((3, len(posteriors), len(centres_m)))
    for start in range(0, len(centres_m), CELLS_AT_ONCE):
        progress(0.5 + 0.4 * start / len(centres_m), "predicting the cells of the grid")
        some = slice(start, start + CELLS_AT_ONCE)
        for c, fitted in enumerate(posteriors):
            mean[c, some], variance[c, some] = fitted.at(centres_m[some])
            gradient[:, c, some] = fitted.gradient_at(centres_m[some]).T
    cells = (len(posteriors), *frame.shape)
    return mean.reshape(cells), variance.reshape(cells), gradient.reshape(3, *cells)


def _predict(conditioned: Conditioned, others: Observations, walk: Walk) -> tuple[Array, Array]:
    """Mean and variance ratio (n, c) of a walk's observations from the others'; the prior's where there are none."""
    if not len(others):
        return np.zeros(walk.field_uT.shape), np.ones(walk.field_uT.shape)
    predictions = [component.at(walk.position_m) for component in conditioned(others)]
    mean, variance = (np.stack(columns, axis=1) for columns in zip(*predictions, strict=True))
    return mean, variance


def _distances_m(a: Array, b: Array) -> Array:
    """(n, m) distances between points (n, d) and (m, d)."""
    return np.asarray(cdist(a, b))
