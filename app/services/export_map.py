"""A map as a file for other tools: NetCDF (classic), Zarr 3 in one zip, NPZ, CSV or CoverageJSON.

Cells that were not measured are left out of the CSV and are missing (NaN or null) everywhere else: a file never
carries an invented value. The same map gives the same bytes: no file says when it was made.
"""

import io
import warnings
import zipfile
from collections.abc import Mapping
from threading import Lock
from typing import Any, Literal

import msgspec
import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray
from scipy.io import netcdf_file

from app.field.grid import FieldGrid
from app.services.map_dataset import AXES, NOTHING, MapDataset, Variable, map_dataset

__all__ = ["EXTENSIONS", "MEDIA_TYPES", "ExportFormat", "export_map"]

_WARNINGS = Lock()  # their filters are the process's, not a thread's
ExportFormat = Literal["netcdf", "zarr", "npz", "covjson", "csv"]
MEDIA_TYPES: dict[ExportFormat, str] = {
    "netcdf": "application/x-netcdf",
    "zarr": "application/zip",
    "npz": "application/octet-stream",
    "covjson": "application/prs.coverage+json",
    "csv": "text/csv",
}
EXTENSIONS: dict[ExportFormat, str] = {
    "netcdf": "nc", "zarr": "zarr.zip", "npz": "npz", "covjson": "covjson", "csv": "csv"
}  # fmt: skip

_CHUNK_CELLS = 512  # a side: a megabyte of single precision
_DECIMALS = 4
_NUMBERS = ("ambient_ut", "prior_sd_ut", "noise_sd_ut", "error_correlation_m")  # of the whole map, in an NPZ
_LONG_AGO = (1980, 1, 1, 0, 0, 0)  # the oldest time a zip knows


def export_map(
    grid: FieldGrid,
    format: ExportFormat,
    map_id: str,
    layers: Mapping[str, NDArray[np.floating]] = NOTHING,
    gradient: bool = True,
    localizability: bool = False,
) -> bytes:
    """A map in one of the formats: mean, standard deviation, slopes (if `gradient`) and further `layers` (nz, ny, nx);
    if `localizability`, gradient norms, information and the expected error of a usual window too.

    `map_id` names the map for ever (its SHA-256), in the formats that have a place for it.
    """
    write = {"netcdf": _netcdf, "zarr": _zarr, "npz": _npz, "covjson": _covjson, "csv": _csv}[format]
    return write(map_dataset(grid, map_id, layers, gradient, localizability))


def _npz(dataset: MapDataset) -> bytes:
    arrays = {f"{axis}_m": dataset.variables[axis].values for axis in AXES}
    arrays["measured"] = dataset.variables["measured"].values.astype(bool)
    arrays |= {name: np.asarray(dataset.attributes[name], np.float64) for name in _NUMBERS}
    out = io.BytesIO()
    np.savez_compressed(out, allow_pickle=False, **arrays, **{name: v.values for name, v in dataset.data.items()})
    return out.getvalue()


def _csv(dataset: MapDataset) -> bytes:
    """One row per measured cell; an empty field where a layer knows nothing."""
    cells = np.nonzero(dataset.variables["measured"].values)
    columns = {f"{axis}_m": dataset.variables[axis].values[at] for axis, at in zip(AXES, cells, strict=True)}
    columns = dict(reversed(columns.items())) | {name: v.values[cells] for name, v in dataset.data.items()}
    table = pa.table({name: pa.array(_rounded(values), from_pandas=True) for name, values in columns.items()})
    out = io.BytesIO()
    pa_csv.write_csv(table, out, pa_csv.WriteOptions(quoting_style="none", quoting_header="none"))
    return out.getvalue()


def _rounded(values: NDArray[Any]) -> NDArray[np.float64]:
    return np.asarray(np.round(values.astype(np.float64), _DECIMALS), np.float64)


def _netcdf(dataset: MapDataset) -> bytes:
    out = io.BytesIO()
    file: Any
    with netcdf_file(out, "w", version=2) as file:
        for attribute, value in dataset.attributes.items():
            setattr(file, attribute, value)
        for variable in dataset.variables.values():
            for dimension, length in zip(variable.dimensions, variable.values.shape, strict=True):
                if dimension not in file.dimensions:
                    file.createDimension(dimension, length)
        for name, variable in dataset.variables.items():
            written = file.createVariable(name, variable.values.dtype, variable.dimensions)
            written[:] = variable.values
            for attribute, value in variable.attributes.items():
                setattr(written, attribute, value)
            if name in dataset.data:
                written._FillValue = np.float32(np.nan)
        file.flush()
        return out.getvalue()


def _zarr(dataset: MapDataset) -> bytes:
    """Zarr 3 with consolidated metadata, all in one uncompressed zip: its chunks are compressed already."""
    import zarr  # here, because it takes most of a second that only this format should pay
    from zarr.storage import MemoryStore

    blobs: dict[str, Any] = {}
    store = MemoryStore(blobs)
    group = zarr.create_group(store, zarr_format=3, attributes=_plain(dataset.attributes))
    for name, variable in dataset.variables.items():
        chunks = tuple(1 if d == "z" else min(n, _CHUNK_CELLS) for d, n in _sizes(variable))
        group.create_array(
            name, data=variable.values, chunks=chunks, dimension_names=variable.dimensions,
            attributes=_plain(variable.attributes), fill_value=np.nan if name in dataset.data else 0,
        )  # fmt: skip
    with _WARNINGS, warnings.catch_warnings():  # that the format's own text does not yet name consolidated metadata
        warnings.simplefilter("ignore", UserWarning)
        zarr.consolidate_metadata(store, zarr_format=3)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        for key in sorted(blobs):
            archive.writestr(zipfile.ZipInfo(key, _LONG_AGO), blobs[key].to_bytes())
    return out.getvalue()


def _sizes(variable: Variable) -> list[tuple[str, int]]:
    return list(zip(variable.dimensions, variable.values.shape, strict=True))


def _plain(attributes: dict[str, Any]) -> dict[str, Any]:
    """Attributes as JSON has them."""
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in attributes.items()}


def _covjson(dataset: MapDataset) -> bytes:
    """A Coverage of the domain type Grid (https://covjson.org/spec); missing values are null."""
    mask = dataset.variables["measured"]
    coverage = {
        "type": "Coverage",
        "id": dataset.attributes["id"],
        "domain": _covjson_domain(dataset),
        "parameters": {"measured": _covjson_flag(mask)}
        | {name: _covjson_parameter(variable) for name, variable in dataset.data.items()},
        "ranges": {"measured": _covjson_range("integer", mask.values.shape, mask.values.ravel().tolist())}
        | {
            name: _covjson_range("float", variable.values.shape, _rounded(variable.values).ravel().tolist())
            for name, variable in dataset.data.items()
        },
    }
    return msgspec.json.encode(coverage)  # NaN becomes null


def _covjson_domain(dataset: MapDataset) -> dict[str, Any]:
    up = {"name": {"en": "height in the building's frame"}, "direction": "up", "unit": {"symbol": "m"}}
    plan = {"type": "ProjectedCRS", "description": {"en": "the building's own plan, x and y in metres along its axes"}}
    return {
        "type": "Domain",
        "domainType": "Grid",
        "axes": {axis: {"values": dataset.variables[axis].values.tolist()} for axis in ("x", "y", "z")},
        "referencing": [
            {"coordinates": ["x", "y"], "system": plan},
            {"coordinates": ["z"], "system": {"type": "VerticalCRS", "cs": {"csAxes": [up]}}},
        ],
    }


def _covjson_parameter(variable: Variable) -> dict[str, Any]:
    code = {"uT": "uT", "uT m-1": "uT/m", "m": "m", "m-2": "m-2", "1": "1"}[variable.attributes["units"]]
    return {
        "type": "Parameter",
        "observedProperty": {"label": {"en": variable.attributes["long_name"]}},
        "unit": {"symbol": {"value": code, "type": "http://www.opengis.net/def/uom/UCUM/"}},
    }


def _covjson_flag(mask: Variable) -> dict[str, Any]:
    names = mask.attributes["flag_meanings"].split()
    return {
        "type": "Parameter",
        "observedProperty": {
            "label": {"en": mask.attributes["long_name"]},
            "categories": [{"id": name, "label": {"en": name.replace("_", " ")}} for name in names],
        },
        "categoryEncoding": {name: int(k) for name, k in zip(names, mask.attributes["flag_values"], strict=True)},
    }


def _covjson_range(kind: str, shape: tuple[int, ...], values: list[Any]) -> dict[str, Any]:
    return {"type": "NdArray", "dataType": kind, "axisNames": list(AXES), "shape": list(shape), "values": values}
