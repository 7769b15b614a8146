"""A map read back from a file that `export_map` wrote: NetCDF or NPZ, for looking at without a server."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.io import netcdf_file
from scipy.ndimage import distance_transform_edt

from app.errors import InvalidInput
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components
from app.geometry import Array

__all__ = ["EXPORT_SUFFIXES", "read_export"]

EXPORT_SUFFIXES = (".nc", ".npz")
_LAYERS = ("coverage", "conflict")
_NUMBERS = ("ambient_ut", "prior_sd_ut", "noise_sd_ut", "error_correlation_m")
_USUAL_NOISE_UT = 0.5  # where a file says nothing
Arrays = dict[str, NDArray[Any]]


def read_export(path: Path) -> tuple[FieldGrid, dict[str, NDArray[np.float32]]]:
    """The grid in a file, and the layers of the fit beside it, (nz, ny, nx) each.

    A file without derivatives gets those between neighbouring cells; what else it lacks is estimated from its cells.
    Raises InvalidInput for a file that cannot be read or is not a map of ours.
    """
    arrays = _read_arrays(path)
    components = _components(path, arrays)
    names = COMPONENT_NAMES[components]
    try:
        grid = _grid(components, arrays)
    except (KeyError, ValueError, AssertionError) as error:
        raise InvalidInput(f"{path}: not a whole map ({error}); export it again") from error
    shape, stored = grid.measured.shape, {name: arrays[name] for name in _LAYERS if name in arrays}
    if wrong := [name for name, values in stored.items() if values.shape != shape]:
        raise InvalidInput(f"{path}: {wrong[0]} has not the size of {names[0]}_ut; export the map again")
    return grid, {name: np.asarray(values, np.float32) for name, values in stored.items()}


def _read_arrays(path: Path) -> Arrays:
    """Every array of the file; axes are called z_m, y_m, x_m."""
    read = {".nc": _read_netcdf, ".npz": _read_npz}.get(path.suffix.lower())
    if read is None:
        raise InvalidInput(f"{path}: a map is read from {' or '.join(EXPORT_SUFFIXES)}, as `isodyn export` writes them")
    try:
        return read(path.read_bytes())
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}") from error
    except (ValueError, TypeError, KeyError, AssertionError, IndexError, EOFError, zipfile.BadZipFile) as error:
        raise InvalidInput(f"{path}: not a {path.suffix} file ({error or type(error).__name__})") from error


def _read_npz(data: bytes) -> Arrays:
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def _read_netcdf(data: bytes) -> Arrays:
    file: Any
    with netcdf_file(io.BytesIO(data), "r", mmap=False) as file:
        arrays = {f"{n}_m" if n in "xyz" else n: np.array(v.data) for n, v in file.variables.items()}
        arrays |= {name: np.atleast_1d(getattr(file, name)) for name in _NUMBERS if hasattr(file, name)}
    return {name: a.astype(a.dtype.newbyteorder("="), copy=False) for name, a in arrays.items()}


def _components(path: Path, arrays: Arrays) -> Components:
    known: tuple[Components, ...] = ("vector", "level", "norm")
    for components in known:
        if all(f"{name}_ut" in arrays for name in COMPONENT_NAMES[components]):
            return components
    raise InvalidInput(f"{path}: no map of Isodyn's: it holds neither bx_ut, by_ut, bz_ut nor another map's components")


def _grid(components: Components, arrays: Arrays) -> FieldGrid:
    names = COMPONENT_NAMES[components]
    x_m, y_m, z_m = (np.asarray(arrays[f"{axis}_m"], np.float64) for axis in "xyz")
    measured = np.asarray(arrays["measured"], bool)
    mean, sd = (np.stack([arrays[f"{n}{what}"] for n in names], axis=-1) for what in ("_ut", "_sd_ut"))
    if any(values.shape[:3] != (len(z_m), len(y_m), len(x_m)) for values in (measured, mean, sd)):
        raise ValueError("sizes differ")
    resolution_m = _resolution_m(x_m, y_m)
    gradient = _gradient(names, arrays, mean, measured, resolution_m)
    ambient, prior_sd, noise = (_numbers(arrays, name, mean, sd, measured) for name in _NUMBERS[:3])
    filled = np.where(measured[..., None], mean, ambient)
    return FieldGrid(
        components=components,
        origin_m=(float(x_m[0]), float(y_m[0])),
        resolution_m=resolution_m,
        heights_m=z_m,
        mean_uT=filled.astype(np.float32),
        sd_uT=np.where(measured[..., None], sd, prior_sd).astype(np.float32),
        gradient_uT_per_m=np.nan_to_num(gradient).astype(np.float32),
        measured=measured,
        ambient_uT=ambient,
        prior_sd_uT=prior_sd,
        noise_sd_uT=noise,
        error_correlation_m=float(np.ravel(arrays.get("error_correlation_m", 0.0))[0]),
    )


def _resolution_m(x_m: Array, y_m: Array) -> float:
    steps_m = np.concatenate([np.diff(x_m), np.diff(y_m)])
    if len(steps_m) == 0:
        return 1.0  # of a single cell nobody can tell
    if steps_m.min() <= 0 or np.ptp(steps_m) > 1e-6:
        raise ValueError("cells are not square")
    return float(steps_m.mean())


def _gradient(
    names: tuple[str, ...], arrays: Arrays, mean: NDArray[Any], measured: NDArray[np.bool_], resolution_m: float
) -> NDArray[Any]:
    """(nz, ny, nx, c, d): as stored, or between neighbours where the file has none."""
    axes = [axis for axis in "xyz" if all(f"d{n}_d{axis}_ut_per_m" in arrays for n in names)]
    if axes[:2] == ["x", "y"]:
        return np.stack(
            [np.stack([arrays[f"d{n}_d{axis}_ut_per_m"] for n in names], axis=-1) for axis in axes], axis=-1
        )
    full = np.stack([_spread(layer, known) for layer, known in zip(mean, measured, strict=True)])
    slopes = [np.gradient(full, resolution_m, axis=a) if full.shape[a] > 1 else np.zeros_like(full) for a in (2, 1)]
    return np.stack(slopes, axis=-1)


def _spread(layer: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[Any]:
    """A layer whose unmeasured cells carry their nearest measured neighbour, so that no slope is missing at the rim."""
    if not known.any():
        return layer
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.asarray(layer[tuple(nearest)])


def _numbers(arrays: Arrays, name: str, mean: NDArray[Any], sd: NDArray[Any], measured: NDArray[np.bool_]) -> Array:
    """A number per component: as stored, or what the cells suggest."""
    if name in arrays:
        return np.atleast_1d(np.asarray(arrays[name], np.float64))
    c = mean.shape[-1]
    if name == "noise_sd_ut" or not measured.any():
        return np.full(c, _USUAL_NOISE_UT)
    cells = mean[measured] if name == "ambient_ut" else sd[measured]
    return np.asarray(cells.mean(axis=0) if name == "ambient_ut" else cells.max(axis=0), dtype=np.float64)
