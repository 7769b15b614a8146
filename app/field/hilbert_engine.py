"""The default engine: learn on a few tiles, then one pass over all of them, one tile in memory at a time."""

from collections.abc import Sequence

from app.field.estimate import FieldEstimate
from app.field.hilbert import posterior
from app.field.learning import learn_hyperparameters
from app.field.leave_one_out import HeldOutPrediction
from app.field.observations import Walk
from app.field.raster import BlendedField, GridFrame
from app.field.spec import MapSpec, Progress
from app.field.statistics import add_evidence, marginalise
from app.field.tiled_walks import TiledWalks
from app.geometry import Array

__all__ = ["estimate_by_hilbert"]


def estimate_by_hilbert(
    walks: Sequence[Walk], ambient_uT: Array, spec: MapSpec, height_m: float | None, progress: Progress
) -> FieldEstimate:
    """The blended field of all tiles, and the walks predicted by subtraction. Raises InvalidInput for a huge grid."""
    hyper, lattice = learn_hyperparameters(
        walks, ambient_uT, spec.kernel, lambda f, message: progress(0.4 * f, message)
    )
    frame = GridFrame.around(walks, spec.resolution_m, hyper.length_m, height_m)
    blended = BlendedField(lattice, frame, len(ambient_uT))
    predicted = HeldOutPrediction(lattice, walks, hyper)
    tiled = TiledWalks(lattice, walks, ambient_uT)
    tiles = list(tiled.counts())
    for index, tile in enumerate(tiles):
        progress(0.4 + 0.6 * index / len(tiles), f"fitting tile {index + 1} of {len(tiles)}")
        basis = lattice.basis(tile)
        surveys = tiled.statistics(tile, hyper.walk_noise_in(basis))
        white_ratio = hyper.white_ratio_in(basis)
        evidence = {name: marginalise(survey, white_ratio, hyper.bias_ratio) for name, survey in surveys.items()}
        total = add_evidence(evidence.values())
        blended.add(tile, posterior(basis, total, hyper))
        predicted.add(tile, evidence, total)
    return FieldEstimate(
        frame=frame,
        mean_uT=blended.mean_uT,
        variance_ratio=blended.variance_ratio[None],
        gradient_uT_per_m=blended.gradient_uT_per_m,
        prior_sd_uT=hyper.signal_sd_uT,
        error_sd_uT=hyper.error_sd_uT,
        held_out_mean_uT=predicted.mean_uT,
        held_out_variance_ratio={name: ratio[:, None] for name, ratio in predicted.variance_ratio.items()},
        hyperparameters=hyper.as_json() | {"tile_pitch_m": lattice.pitch_m},
    )
