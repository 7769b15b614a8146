"""Grids, their layers, and samples as bytes and back: safetensors, which maps plain arrays and cannot carry code.

The same values always give the same bytes, so a map's content hash is also the test that two fits agree.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from app.errors import CorruptArtefact
from app.field.error_structure import UNKNOWN_STRUCTURE, ErrorStructure
from app.field.grid import FieldGrid
from app.field.samples import Samples

__all__ = [
    "grid_from_bytes",
    "grid_to_bytes",
    "layers_from_bytes",
    "layers_to_bytes",
    "samples_from_bytes",
    "samples_to_bytes",
]


def grid_to_bytes(grid: FieldGrid) -> bytes:
    """A grid as one immutable blob."""
    return pack(
        {"kind": "grid", "components": grid.components, "resolution_m": grid.resolution_m,
         "origin_m": list(grid.origin_m), "error_correlation_m": grid.error_correlation_m,
         "error_structure": asdict(grid.error_structure)},
        {"heights_m": grid.heights_m, "mean_uT": grid.mean_uT, "sd_uT": grid.sd_uT,
         "gradient_uT_per_m": grid.gradient_uT_per_m, "measured": grid.measured, "ambient_uT": grid.ambient_uT,
         "prior_sd_uT": grid.prior_sd_uT, "noise_sd_uT": grid.noise_sd_uT},
    )  # fmt: skip


def grid_from_bytes(data: bytes) -> FieldGrid:
    """The grid in a blob. Raises CorruptArtefact."""
    header, arrays = unpack(data, "grid")
    return FieldGrid(
        components=header["components"],
        origin_m=(header["origin_m"][0], header["origin_m"][1]),
        resolution_m=header["resolution_m"],
        error_correlation_m=header["error_correlation_m"],
        error_structure=ErrorStructure(**told) if (told := header.get("error_structure")) else UNKNOWN_STRUCTURE,
        **arrays,
    )


def layers_to_bytes(layers: Mapping[str, NDArray[Any]]) -> bytes:
    """Further layers of a grid, (nz, ny, nx) each, as one immutable blob in single precision."""
    return pack({"kind": "layers"}, {name: np.asarray(layer, np.float32) for name, layer in layers.items()})


def layers_from_bytes(data: bytes) -> dict[str, NDArray[np.float32]]:
    """The layers in a blob, by name. Raises CorruptArtefact."""
    _, arrays = unpack(data, "layers")
    return dict(sorted(arrays.items()))


def samples_to_bytes(samples: Samples) -> bytes:
    """One walk's samples as one immutable blob."""
    arrays = {"t_s": samples.t_s, "p_building_m": samples.p_building_m, "B_uT": samples.B_uT}
    if samples.q_body_to_building is not None:
        arrays["q_body_to_building"] = samples.q_body_to_building
    return pack({"kind": "samples", "frame": samples.frame, "session": samples.session}, arrays)


def samples_from_bytes(data: bytes) -> Samples:
    """The samples in a blob. Raises CorruptArtefact."""
    header, arrays = unpack(data, "samples")
    return Samples(frame=header["frame"], session=header["session"], **arrays)


def pack(header: dict[str, Any], arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Arrays by name under a JSON header, whose `kind` says what they are."""
    # One metadata entry, because the order of several is not fixed and the bytes must be.
    metadata = {"isodyn": json.dumps({"version": 1, **header}, sort_keys=True)}
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()}, metadata)


def unpack(data: bytes, kind: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Header and arrays of a blob. Raises CorruptArtefact when they are not of this kind."""
    try:
        length = int.from_bytes(data[:8], "little")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["isodyn"])
        arrays = load(data)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        raise CorruptArtefact(f"stored {kind} cannot be read: {error}") from error
    if header.get("kind") != kind:
        raise CorruptArtefact(f"a stored {kind} was expected, this is a {header.get('kind')}")
    return header, arrays
