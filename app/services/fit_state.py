"""What a fit leaves for the next one, as bytes and back: what was learned and the fits of the tiles.

A state is a cache. It is read only by the version of the program that wrote it, since the next fit must be the same as
one from nothing, bit for bit; whatever cannot be read makes the next build a full one.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app import __version__
from app.errors import CorruptArtefact
from app.field.body_bias import BodyBias
from app.field.hard_iron import HardIron
from app.field.hilbert import Patch
from app.field.hyperparameters import Hyperparameters
from app.field.tile_fit import FitState, HeldOutPart, Learned, TileFit
from app.field.tiles import Lattice, Slab, Tile
from app.services.artefacts import pack, unpack

__all__ = ["LARGEST_BYTES", "Excluded", "state_from_bytes", "state_to_bytes"]

LARGEST_BYTES = 400_000_000
"""A larger state is not kept: reading it would cost as much as fitting anew."""
_VERSION = f"{__version__}-3"

Excluded = Mapping[str, Sequence[Sequence[float]]]
"""By survey id, the stretches of its time that it was fitted without."""


def state_to_bytes(state: FitState, excluded_s: Excluded) -> bytes | None:
    """One blob; None when it would be too large to be of use. `excluded_s`: what surveys were fitted without."""
    learned = state.learned
    surveys = sorted({survey_id for fit in state.tiles.values() for survey_id in fit.surveys})
    number = {survey_id: index for index, survey_id in enumerate(surveys)}
    single, double = _Flat(np.float32), _Flat(np.float64)
    tiles = []
    for tile, fit in state.tiles.items():
        patch = fit.patch
        for values in (patch.mean_uT, patch.gradient_uT_per_m, patch.variance_ratio):
            single.add(values)
        double.add(fit.borders)
        if patch.potential_uT_m is not None:
            double.add(patch.potential_uT_m)
        double.add(fit.held_out.mean_uT)
        double.add(fit.held_out.variance_ratio)
        tiles.append(
            [
                list(tile),
                [number[survey_id] for survey_id in fit.surveys],
                patch.potential_uT_m is not None,
            ]
        )
    if 4 * single.size + 8 * double.size > LARGEST_BYTES:
        return None
    hyper = {name: getattr(learned.hyper, name) for name in Hyperparameters.__dataclass_fields__}
    signal_sd_uT = hyper.pop("signal_sd_uT")
    header = {
        "written_by": _VERSION,
        "hyper": hyper | {name: dict(hyper[name]) for name in ("noise_scale", "offset_ratio")},
        "sessions": {name: _listed(bias) for name, bias in state.hard_iron.sessions.items()},
        "alone": {name: _listed(bias) for name, bias in state.hard_iron.surveys.items()},
        "lattice": asdict(learned.lattice),
        "samples": learned.samples,
        "surveys": surveys,
        "tiles": tiles,
        "shapes": [single.shapes, double.shapes],
        "excluded_s": dict(excluded_s),
    }
    arrays = {
        "signal_sd_uT": signal_sd_uT,
        "ambient_uT": learned.ambient_uT,
        "heights_m": state.heights_m,
        "single": single.joined(),
        "double": double.joined(),
    }
    return pack({"kind": "fit state", **header}, arrays)


def state_from_bytes(data: bytes, excluded_s: Excluded) -> FitState:
    """The state in a blob. Raises CorruptArtefact, also for one that another version wrote, or that was fitted from

    other stretches of a survey than these.
    """
    header, arrays = unpack(data, "fit state")
    if header.get("written_by") != _VERSION:
        raise CorruptArtefact(f"the fit state was written by version {header.get('written_by')}, this is {_VERSION}")
    for survey_id in header["surveys"]:
        if header["excluded_s"].get(survey_id, []) != excluded_s.get(survey_id, []):
            raise CorruptArtefact(f"the fit state has other stretches of survey {survey_id}")
    single = _arrays(arrays["single"].astype(np.float64), header["shapes"][0])
    double = _arrays(arrays["double"], header["shapes"][1])
    surveys: list[str] = header["surveys"]
    tiles = {}
    for place, crossing, has_potential in header["tiles"]:
        mean, gradient, variance, borders = next(single), next(single), next(single), next(double)
        patch = Patch(mean, gradient, variance, next(double) if has_potential else None)
        held_out = HeldOutPart(next(double), next(double))
        tiles[Tile(*place)] = TileFit(tuple(surveys[index] for index in crossing), patch, held_out, borders)
    hyper = Hyperparameters(signal_sd_uT=arrays["signal_sd_uT"], **header["hyper"])
    learned = Learned(hyper, _lattice(header["lattice"]), arrays["ambient_uT"], header["samples"])
    hard_iron = HardIron(
        {name: BodyBias(*map(np.array, bias)) for name, bias in header["sessions"].items()},
        {name: BodyBias(*map(np.array, bias)) if bias else None for name, bias in header["alone"].items()},
    )
    return FitState(learned, arrays["heights_m"], hard_iron, tiles)


def _listed(bias: BodyBias | None) -> list[list[Any]] | None:
    return None if bias is None else [bias.bias_body_uT.tolist(), bias.covariance_uT2.tolist()]


class _Flat:
    """Many arrays as one, with their shapes."""

    def __init__(self, dtype: type[np.floating[Any]]) -> None:
        self._dtype = dtype
        self._parts: list[NDArray[Any]] = []
        self.shapes: list[list[int]] = []
        self.size = 0

    def add(self, values: NDArray[Any]) -> None:
        self._parts.append(np.asarray(values, dtype=self._dtype).ravel())
        self.shapes.append(list(values.shape))
        self.size += values.size

    def joined(self) -> NDArray[Any]:
        return np.concatenate(self._parts) if self._parts else np.zeros(0, dtype=self._dtype)


def _arrays(flat: NDArray[Any], shapes: list[list[int]]) -> Iterator[NDArray[Any]]:
    start = 0
    for shape in shapes:
        stop = start + int(np.prod(shape))
        yield flat[start:stop].reshape(shape)
        start = stop


def _lattice(fields: Mapping[str, Any]) -> Lattice:
    slab = fields["slab"]
    if slab is not None:
        slab = Slab(**slab | {"air_m": tuple(slab["air_m"]), "inner_m": tuple(slab["inner_m"])})
    return Lattice(**{**fields, "slab": slab})
