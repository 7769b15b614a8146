"""Heavy-tailed errors: a Student likelihood by iterated weights, tile by tile.

A Student error is a Gaussian one whose variance is drawn anew for every observation. Given the field, the expected
inverse of that variance is `(nu + 1) / (nu + r^2 / s^2)` (Lange, Little & Taylor 1989), so fits and weights alternate;
r^2 includes the field's own posterior variance, and what it is compared with all errors of one observation: offset and
correlated error too, so that a well-modelled drift along the walk is not taken for outliers.
"""

import numpy as np

from app.field.hilbert import posterior
from app.field.hyperparameters import Hyperparameters
from app.field.statistics import Evidence, add_evidence
from app.field.tiled_walks import TiledWalks
from app.field.tiles import Tile

__all__ = ["FREEDOM", "student_evidence"]

FREEDOM = 4.0
ROUNDS = 3


def student_evidence(tiled: TiledWalks, tile: Tile, hyper: Hyperparameters) -> dict[str, Evidence]:
    """Survey id -> its evidence in the tile, the variance of every observation's white error as large as it seems."""
    basis, parts = tiled.lattice.basis(tile), tiled.parts(tile)
    evidence = tiled.evidence(tile, hyper)
    for _ in range(ROUNDS):
        fitted = posterior(basis, add_evidence(evidence.values()), hyper)
        scales = {}
        for survey_id, part in parts.items():
            mean_uT, variance_ratio = fitted.at(part.points_m)
            scale = hyper.noise_scale.get(survey_id, 1.0)
            noise_ratio = hyper.white_ratio_in(basis, survey_id) + scale * (hyper.bias_ratio + hyper.walk_ratio)
            squared = np.mean(np.square((part.deviation_uT - mean_uT) / hyper.signal_sd_uT), axis=1)
            squared = squared + variance_ratio.mean(axis=1)
            scales[survey_id] = (FREEDOM + squared / noise_ratio) / (FREEDOM + 1.0)
        evidence = tiled.evidence(tile, hyper, scales)
    return evidence
