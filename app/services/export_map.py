"""A map as a file for other tools: NPZ, CSV, NetCDF (classic, CF attributes) or CoverageJSON.

Cells that were not measured are left out of the CSV and are masked (NaN or null) everywhere else: a file never
carries an invented value.
"""

import io
import json
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file

from app.field.grid import FieldGrid

__all__ = ["MEDIA_TYPES", "ExportFormat", "export_map"]

ExportFormat = Literal["netcdf", "npz", "covjson", "csv"]
MEDIA_TYPES: dict[ExportFormat, str] = {
    "netcdf": "application/x-netcdf",
    "npz": "application/octet-stream",
    "covjson": "application/prs.coverage+json",
    "csv": "text/csv",
}


def export_map(grid: FieldGrid, format: ExportFormat) -> bytes:
    """The map's mean and standard deviation in one of the formats; the same map always gives the same bytes."""
    return {"netcdf": _netcdf, "npz": _npz, "covjson": _covjson, "csv": _csv}[format](grid)


def _axes(grid: FieldGrid) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    _, ny, nx, _ = grid.mean_uT.shape
    x = grid.origin_m[0] + grid.resolution_m * np.arange(nx)
    y = grid.origin_m[1] + grid.resolution_m * np.arange(ny)
    return grid.heights_m, y, x


def _masked(grid: FieldGrid) -> dict[str, NDArray[np.float32]]:
    """Every layer by name, NaN where nothing was measured: (nz, ny, nx)."""
    layers = {}
    for c, name in enumerate(grid.component_names):
        layers[f"{name}_ut"] = np.where(grid.measured, grid.mean_uT[..., c], np.float32(np.nan))
        layers[f"{name}_sd_ut"] = np.where(grid.measured, grid.sd_uT[..., c], np.float32(np.nan))
    return layers


def _npz(grid: FieldGrid) -> bytes:
    z, y, x = _axes(grid)
    out = io.BytesIO()
    np.savez_compressed(out, allow_pickle=False, z_m=z, y_m=y, x_m=x, measured=grid.measured, **_masked(grid))
    return out.getvalue()


def _csv(grid: FieldGrid) -> bytes:
    z, y, x = _axes(grid)
    k, j, i = np.nonzero(grid.measured)
    layers = _masked(grid)
    out = io.StringIO()
    out.write(",".join(["x_m", "y_m", "z_m", *layers]) + "\n")
    table = np.column_stack([x[i], y[j], z[k], *(layer[k, j, i] for layer in layers.values())])
    np.savetxt(out, table, fmt=["%.3f"] * 3 + ["%.4f"] * len(layers), delimiter=",")
    return out.getvalue().encode()


def _netcdf(grid: FieldGrid) -> bytes:
    z, y, x = _axes(grid)
    out = io.BytesIO()
    file: Any
    with netcdf_file(out, "w", version=2) as file:
        file.Conventions, file.title = "CF-1.10", "Isodyn magnetic field map"
        for name, values, axis in (("z", z, "Z"), ("y", y, "Y"), ("x", x, "X")):
            file.createDimension(name, len(values))
            variable = file.createVariable(name, "f8", (name,))
            variable[:] = values
            variable.units, variable.axis, variable.long_name = "m", axis, f"building frame {name}"
        for name, layer in _masked(grid).items():
            variable = file.createVariable(name, "f4", ("z", "y", "x"))
            variable[:] = layer
            variable.units, variable._FillValue = "microtesla", np.float32(np.nan)
        file.flush()
        return out.getvalue()


def _covjson(grid: FieldGrid) -> bytes:
    z, y, x = _axes(grid)
    layers = _masked(grid)
    unit = {"symbol": {"value": "uT", "type": "http://www.opengis.net/def/uom/UCUM/"}}
    coverage = {
        "type": "Coverage",
        "domain": {
            "type": "Domain",
            "domainType": "Grid",
            "axes": {"x": {"values": x.tolist()}, "y": {"values": y.tolist()}, "z": {"values": z.tolist()}},
            "referencing": [
                {"coordinates": ["x", "y", "z"], "system": {"type": "ProjectedCRS", "id": "building"}}
            ],
        },
        "parameters": {
            name: {"type": "Parameter", "unit": unit, "observedProperty": {"label": {"en": name}}} for name in layers
        },
        "ranges": {
            name: {
                "type": "NdArray",
                "dataType": "float",
                "axisNames": ["z", "y", "x"],
                "shape": list(layer.shape),
                "values": [None if np.isnan(v) else round(float(v), 4) for v in layer.ravel()],
            }
            for name, layer in layers.items()
        },
    }  # fmt: skip
    return json.dumps(coverage, allow_nan=False).encode()
