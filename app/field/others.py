"""Every walk predicted from the others, with the gradient of what predicts it: what a correction of labels starts from.

As the leave-one-survey-out score by subtraction, for any choice of the walks that make the map. The gradient is that
of the blended field itself: central differences of a centimetre, over which a field that bends in metres is straight.
"""

from collections.abc import Collection, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from app.field.hilbert import predict
from app.field.observations import Walk, walk_bounds
from app.field.statistics import add_evidence
from app.field.tile_fit import Learned
from app.field.tiled_walks import TiledWalks
from app.geometry import Array

__all__ = ["FromOthers", "predict_from_others"]

STEP_M = 0.01
_AROUND_M = STEP_M * np.array([(0, 0, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)])


class FromOthers(NamedTuple):
    """Of one walk's observations: mean_uT (n, c), variance_uT2 (n, c) of the latent field, gradient_uT_per_m (n, c, 2)

    over x and y.
    """

    mean_uT: Array
    variance_uT2: Array
    gradient_uT_per_m: Array


def predict_from_others(walks: Sequence[Walk], learned: Learned, mapping: Collection[str]) -> dict[str, FromOthers]:
    """Survey id -> every walk, at its labels, from the walks named in `mapping` but itself."""
    lattice, hyper = learned.lattice, learned.hyper
    tiled = TiledWalks(lattice, walks, learned.ambient_uT)
    n, c = len(tiled.points_m), len(learned.ambient_uT)
    mean_uT, variance_ratio = np.zeros((n, len(_AROUND_M), c)), np.ones((n, c))
    for tile in tiled.counts():
        basis = lattice.basis(tile)
        known = {name: each for name, each in tiled.evidence(tile, hyper).items() if name in mapping}
        total = add_evidence(known.values()) if known else None
        for name, inside in tiled.answered(tile).items():
            if total is None or set(known) == {name}:
                continue
            others = total - known[name] if name in known else total
            around_m = (tiled.points_m[inside][:, None] + _AROUND_M).reshape(-1, 3)
            part_uT, part_variance = predict(basis, others, hyper, around_m)
            weight = lattice.weight(0, tile, around_m[:, 0]) * lattice.weight(1, tile, around_m[:, 1])
            mean_uT[inside] += (weight[:, None] * part_uT).reshape(-1, len(_AROUND_M), c)
            here = slice(None, None, len(_AROUND_M))
            variance_ratio[inside] += weight[here, None] * (part_variance[here] - 1.0)
    slope_x, slope_y = (mean_uT[:, 1] - mean_uT[:, 2]), (mean_uT[:, 3] - mean_uT[:, 4])
    gradient = np.stack([slope_x, slope_y], axis=-1) / (2.0 * STEP_M)
    variance_uT2 = variance_ratio * np.square(hyper.signal_sd_uT)
    cut = [slice(start, stop) for start, stop in pairwise(walk_bounds(walks))]
    return {
        walk.survey_id: FromOthers(mean_uT[part, 0] + learned.ambient_uT, variance_uT2[part], gradient[part])
        for walk, part in zip(walks, cut, strict=True)
    }
