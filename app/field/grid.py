"""The map as it is served: an immutable grid of cells. Samples went in; every query reads only this.

Cell [j, i] of layer k is centred on `(x0 + i r, y0 + j r, heights_m[k])`. Values between centres are bilinear in
the plane and linear between layers. Cells far from any sample hold the prior (ambient mean, prior sd) and are not
`measured`: their values are never served as a field, but a matcher may score against them ("somewhere unmapped").
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.field.error_structure import UNKNOWN_STRUCTURE, ErrorStructure
from app.field.samples import COMPONENT_NAMES, Components
from app.geometry import Array

__all__ = ["FieldGrid", "FieldValues"]

AT_HEIGHT_M = 0.01
"""This far above or below its layers a map of several heights still answers."""

Float32 = NDArray[np.float32]


class FieldValues(NamedTuple):
    """The field at points: mean and latent sd (n, c) uT, gradient (n, c, d) uT/m over x, y (and z), measured (n,)."""

    mean_uT: Array
    sd_uT: Array
    gradient_uT_per_m: Array
    measured: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class FieldGrid:
    """mean_uT, sd_uT (nz, ny, nx, c): posterior mean and latent standard deviation of the field
    gradient_uT_per_m (nz, ny, nx, c, d): exact derivative of the mean with x and y (d = 2), and with z (d = 3) where
        the field was fitted in three dimensions
    measured (nz, ny, nx): cells close enough to samples to be served
    ambient_uT, prior_sd_uT (c,): what the field is taken to be where nothing was measured
    noise_sd_uT (c,): learned sd of one further measurement about the latent field (all error terms together)
    error_correlation_m: distance walked over which errors against the map stay correlated (from leave-one-survey-out
        residuals); 0 when unknown
    error_structure: how those errors hang together; what a window is worth follows from it
    """

    components: Components
    origin_m: tuple[float, float]
    resolution_m: float
    heights_m: Array
    mean_uT: Float32
    sd_uT: Float32
    gradient_uT_per_m: Float32
    measured: NDArray[np.bool_]
    ambient_uT: Array
    prior_sd_uT: Array
    noise_sd_uT: Array
    error_correlation_m: float = 0.0
    error_structure: ErrorStructure = UNKNOWN_STRUCTURE

    def __post_init__(self) -> None:
        nz, ny, nx, c = self.mean_uT.shape
        assert c == len(COMPONENT_NAMES[self.components]), (c, self.components)
        assert self.heights_m.shape == (nz,)
        assert self.sd_uT.shape == (nz, ny, nx, c)
        assert self.gradient_uT_per_m.shape in ((nz, ny, nx, c, 2), (nz, ny, nx, c, 3))
        assert self.measured.shape == (nz, ny, nx)
        assert self.ambient_uT.shape == self.prior_sd_uT.shape == self.noise_sd_uT.shape == (c,)

    @property
    def component_names(self) -> tuple[str, ...]:
        return COMPONENT_NAMES[self.components]

    @property
    def bounds_m(self) -> tuple[float, float, float, float, float, float]:
        """(x_min, y_min, z_min, x_max, y_max, z_max) of the cell centres."""
        _, ny, nx, _ = self.mean_uT.shape
        x0, y0 = self.origin_m
        x1, y1 = x0 + (nx - 1) * self.resolution_m, y0 + (ny - 1) * self.resolution_m
        return x0, y0, float(self.heights_m[0]), x1, y1, float(self.heights_m[-1])

    @property
    def nbytes(self) -> int:
        return self.mean_uT.nbytes + self.sd_uT.nbytes + self.gradient_uT_per_m.nbytes + self.measured.nbytes

    def at(self, points_m: Array) -> FieldValues:
        """The field at points (n, 3) or (n, 2) of the building frame.

        A map with one height answers at that height whatever z says; with several, between them (points without z: at
        the lowest). A point is `measured` when the four cell centres around it are, on every layer used; outside the
        map values are the prior's, so that a caller who ignores `measured` gets an honest, wide answer.
        """
        p = np.atleast_2d(np.asarray(points_m, dtype=np.float64))
        n = len(p)
        nz, ny, nx, c = self.mean_uT.shape
        u = (p[:, 0] - self.origin_m[0]) / self.resolution_m
        v = (p[:, 1] - self.origin_m[1]) / self.resolution_m
        inside = (u >= 0) & (u <= nx - 1) & (v >= 0) & (v <= ny - 1) & self.between_layers(p)
        i = np.clip(np.floor(u).astype(np.int64), 0, max(nx - 2, 0))
        j = np.clip(np.floor(v).astype(np.int64), 0, max(ny - 2, 0))
        fu, fv = np.clip(u - i, 0.0, 1.0), np.clip(v - j, 0.0, 1.0)
        layer, fz = self._layers(p)
        mean, variance = np.zeros((2, n, c))
        gradient = np.zeros((n, *self.gradient_uT_per_m.shape[3:]))
        measured = inside.copy()
        for k, wz in ((layer, 1.0 - fz), (np.minimum(layer + 1, nz - 1), fz)):
            for dj, wv in ((0, 1.0 - fv), (1, fv)):
                for di, wu in ((0, 1.0 - fu), (1, fu)):
                    jj, ii = np.minimum(j + dj, ny - 1), np.minimum(i + di, nx - 1)
                    w = wz * wv * wu
                    mean += w[:, None] * self.mean_uT[k, jj, ii]
                    variance += w[:, None] * np.square(self.sd_uT[k, jj, ii].astype(np.float64))
                    gradient += w[:, None, None] * self.gradient_uT_per_m[k, jj, ii]
                    measured &= self.measured[k, jj, ii] | (w == 0.0)
        outside = ~inside
        mean[outside], variance[outside], gradient[outside] = self.ambient_uT, np.square(self.prior_sd_uT), 0.0
        return FieldValues(mean, np.sqrt(variance), gradient, measured)

    def between_layers(self, p: Array) -> NDArray[np.bool_]:
        """Whether points (n, 2 or 3) are between the lowest and the highest layer; one layer holds for all heights."""
        if len(self.heights_m) == 1 or p.shape[1] < 3:
            return np.ones(len(p), dtype=np.bool_)
        low_m, high_m = self.heights_m[[0, -1]]
        return np.asarray((p[:, 2] >= low_m - AT_HEIGHT_M) & (p[:, 2] <= high_m + AT_HEIGHT_M))

    def _layers(self, p: Array) -> tuple[NDArray[np.int64], Array]:
        """Index of the layer below each point and the fraction of the way to the next one."""
        nz = len(self.heights_m)
        if nz == 1 or p.shape[1] < 3:
            return np.zeros(len(p), dtype=np.int64), np.zeros(len(p))
        k = np.clip(np.searchsorted(self.heights_m, p[:, 2], side="right") - 1, 0, nz - 2)
        f = (p[:, 2] - self.heights_m[k]) / (self.heights_m[k + 1] - self.heights_m[k])
        return k, np.clip(f, 0.0, 1.0)
