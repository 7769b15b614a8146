"""One reading of the field against the cells of a map around a prior: everything in logarithms (Storms, L561-575).

The posterior over cells is what a position fix is taken from: its highest cell (`position_fix.ml_fix`) or its moments
(`position_fix.matched_fix`). Unknown cells have no probability.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from app.geometry import Array
from app.tracking.map_cells import MapCells

__all__ = ["GridPosterior", "grid_posterior", "local_maxima", "log_likelihood", "log_prior", "search_half_m"]

_MOST_CELLS = 2500


@dataclass(frozen=True, slots=True, eq=False)
class GridPosterior:
    """The cells searched; misfit, log likelihood and log posterior (ny, nx), -inf (misfit: inf) where unknown.

    `misfit` is the sum of squared residuals over their variances: chi-square under a correct model. `resolved`:
    cells are points of a lattice fine enough for sums to be integrals; else each is a square of its mass.
    """

    cells: MapCells
    misfit: Array
    log_likelihood: Array
    log_posterior: Array
    resolved: bool = False

    @property
    def best(self) -> tuple[int, int]:
        """Row and column of the likeliest cell."""
        j, i = np.unravel_index(int(np.argmax(self.log_posterior)), self.log_posterior.shape)
        return int(j), int(i)

    def position_m(self, cell: tuple[int, int]) -> Array:
        """(2,) the centre of a cell [row, column]."""
        r = self.cells.resolution_m
        return np.array([self.cells.origin_m[0] + cell[1] * r, self.cells.origin_m[1] + cell[0] * r])

    def mass(self) -> Array:
        """(ny, nx) probability of each cell."""
        mass = np.exp(self.log_posterior - self.log_posterior.max())
        return np.asarray(mass / mass.sum())

    def moments(self) -> tuple[Array, Array]:
        """Mean (2,) and covariance (2, 2) of the position."""
        mass, x, y = self.mass(), self.cells.x_m, self.cells.y_m
        of_x, of_y = mass.sum(axis=0), mass.sum(axis=1)
        mean = np.array([of_x @ x, of_y @ y])
        u, v = x - mean[0], y - mean[1]
        cross = float(v @ mass @ u)
        covariance = np.array([[of_x @ u**2, cross], [cross, of_y @ v**2]])
        return mean, covariance + (not self.resolved) * np.eye(2) * self.cells.resolution_m**2 / 12.0

    def border_mass(self) -> float:
        """Probability of the outermost cells of the window: what it has probably cut off."""
        mass = self.mass()
        return float(1.0 - mass[1:-1, 1:-1].sum())


def search_half_m(covariance_m2: Array, sigmas: float, least_m: float, most_m: float) -> Array:
    """(2,) half sides of the window searched, from the prior's standard deviations (Cuenca, L611, eq. 3.3)."""
    return np.asarray(np.clip(sigmas * np.sqrt(np.diag(covariance_m2)), least_m, most_m))


def log_prior(cells: MapCells, mean_m: Array, covariance_m2: Array) -> Array:
    """(ny, nx) Gaussian at the cell centres, its constant left out (Storms, L561-567, eq. 3.5, exponent corrected)."""
    (a, b), (_, d) = np.linalg.inv(covariance_m2)
    u, v = cells.x_m - mean_m[0], cells.y_m - mean_m[1]
    return np.asarray(-0.5 * (a * u**2 + d * v[:, None] ** 2) - b * v[:, None] * u)


def log_likelihood(
    cells: MapCells, reading_uT: Array, noise_sd_uT: float, map_variance: bool = True
) -> tuple[Array, Array]:
    """Misfit and log likelihood (ny, nx) of one reading (c,) (Storms, L569-573, eq. 3.6).

    The variance is the sensor's and, unless `map_variance` is False as in the source, the map's at the cell; since it
    then varies, its log-determinant counts. The normaliser is (2 pi sigma^2)^(-c/2), not as printed.
    """
    squared = np.square(cells.mean_uT - reading_uT)
    if map_variance:
        variance = noise_sd_uT**2 + cells.variance_uT2
        misfit = np.sum(squared / variance, axis=2)
        log_determinant = np.sum(np.log(2.0 * np.pi * variance), axis=2)
    else:
        misfit = np.sum(squared, axis=2) / noise_sd_uT**2
        log_determinant = np.full(cells.known.shape, len(reading_uT) * np.log(2.0 * np.pi * noise_sd_uT**2))
    misfit = np.where(cells.known, misfit, np.inf)
    return misfit, np.where(cells.known, -0.5 * (misfit + log_determinant), -np.inf)


def grid_posterior(
    cells: MapCells,
    reading_uT: Array,
    mean_m: Array,
    covariance_m2: Array,
    half_m: Array,
    noise_sd_uT: float,
    *,
    map_variance: bool = True,
    use_prior: bool = True,
    resolve_prior: bool = False,
) -> GridPosterior | None:
    """Prior times likelihood of one reading (c,) uT over the cells within `half_m` (2,) (Storms, L575).

    Without `use_prior` all cells of the window weigh alike. `resolve_prior` takes a finer lattice where cells are wider
    than a quarter of the prior's sd, and counts half of what the field changes across a cell as an sd. None where no
    cell is known: there is no fix.
    """
    window = _resolved(cells, mean_m, covariance_m2, half_m) if resolve_prior else cells.window(mean_m, half_m)
    if window is None or not window.known.any():
        return None
    misfit, likelihood = log_likelihood(window, reading_uT, noise_sd_uT, map_variance)
    prior = log_prior(window, mean_m, covariance_m2) if use_prior else 0.0
    return GridPosterior(window, misfit, likelihood, likelihood + prior, resolve_prior)


def _resolved(cells: MapCells, mean_m: Array, covariance_m2: Array, half_m: Array) -> MapCells | None:
    """The window, its lattice as fine as the prior wants but for `_MOST_CELLS`, its variance with that within cells."""
    fine_m = 0.25 * float(np.sqrt(np.linalg.eigvalsh(covariance_m2)[0]))
    spacing_m = max(fine_m, float(np.sqrt(4.0 * np.prod(half_m) / _MOST_CELLS)))
    coarse = spacing_m >= cells.resolution_m
    window = cells.window(mean_m, half_m) if coarse else cells.resampled(mean_m, half_m, spacing_m)
    if window is None or min(window.known.shape) < 2:
        return window
    squared = sum(np.square(np.gradient(window.mean_uT, axis=axis)) for axis in (0, 1))
    within = 0.25 * np.where(np.isfinite(squared), squared, 0.0)
    return MapCells(window.origin_m, window.resolution_m, window.mean_uT, window.variance_uT2 + within, window.known)


def local_maxima(log_posterior: Array, within: float) -> NDArray[np.int64]:
    """Cells (k, 2) [row, column] that no neighbour exceeds, at most `within` below the best; best first."""
    best = float(log_posterior.max())
    peak = (log_posterior >= best - within) & np.isfinite(log_posterior)
    peak &= log_posterior >= maximum_filter(log_posterior, size=3, mode="constant", cval=-np.inf)
    found = np.argwhere(peak)
    return found[np.argsort(-log_posterior[peak], kind="stable")]
