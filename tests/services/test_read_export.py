"""A map read back from its own export; anything else is refused with a sentence."""

import io
from pathlib import Path

import numpy as np
import pytest

from app.errors import InvalidInput
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components
from app.services.export_map import export_map
from app.services.read_export import read_export


def make_grid(
    components: Components = "vector", shape: tuple[int, int, int] = (2, 9, 13), slopes: int = 2
) -> FieldGrid:
    """A field that is linear in x and y, so that slopes between neighbours are exact."""
    c, (nz, ny, nx) = len(COMPONENT_NAMES[components]), shape
    x, y = 0.3 * np.arange(nx), 0.3 * np.arange(ny)
    plane = 30.0 + 2.0 * x[None, :] - y[:, None]
    mean = np.repeat(np.broadcast_to(plane, shape)[..., None], c, axis=-1)
    gradient = np.zeros((*mean.shape, slopes))
    gradient[..., 0], gradient[..., 1] = 2.0, -1.0
    return FieldGrid(
        components=components,
        origin_m=(-1.3, 40.1),
        resolution_m=0.3,
        heights_m=np.array([0.4, 1.2, 2.9])[:nz],
        mean_uT=mean.astype(np.float32),
        sd_uT=np.full(mean.shape, 0.7, np.float32),
        gradient_uT_per_m=gradient.astype(np.float32),
        measured=np.random.default_rng(1).uniform(size=shape) > 0.3,
        ambient_uT=np.arange(1.0, c + 1.0),
        prior_sd_uT=np.full(c, 9.0),
        noise_sd_uT=np.full(c, 0.4),
        error_correlation_m=2.5,
    )


def written(folder: Path, grid: FieldGrid, format: str, **options) -> Path:
    path = folder / {"netcdf": "map.nc", "npz": "map.npz"}[format]
    layers = {"coverage": np.ones(grid.measured.shape, np.float32)}
    path.write_bytes(export_map(grid, format, "0" * 64, layers, **options))
    return path


@pytest.mark.parametrize("format", ["netcdf", "npz"])
@pytest.mark.parametrize("components", ["vector", "level", "norm"])
@pytest.mark.parametrize("slopes", [2, 3])
def test_what_was_written_is_read(format, components, slopes, tmp_path):
    grid = make_grid(components, slopes=slopes)
    read, layers = read_export(written(tmp_path, grid, format))
    assert read.components == components
    np.testing.assert_allclose(read.bounds_m, grid.bounds_m)
    np.testing.assert_array_equal(read.measured, grid.measured)
    for name in ("mean_uT", "sd_uT", "gradient_uT_per_m"):
        np.testing.assert_array_equal(getattr(read, name)[grid.measured], getattr(grid, name)[grid.measured])
        assert np.isfinite(getattr(read, name)).all()
    for name in ("heights_m", "ambient_uT", "prior_sd_uT", "noise_sd_uT", "error_correlation_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(grid, name))
    assert list(layers) == ["coverage"]
    np.testing.assert_array_equal(layers["coverage"][grid.measured], 1.0)


@pytest.mark.parametrize("format", ["netcdf", "npz"])
def test_slopes_that_were_left_out_are_those_between_cells(format, tmp_path):
    grid = make_grid()
    grid.measured[:] = True
    read, _ = read_export(written(tmp_path, grid, format, gradient=False))
    np.testing.assert_allclose(read.gradient_uT_per_m, grid.gradient_uT_per_m, rtol=1e-4)


def test_a_file_that_says_less_is_still_a_map(tmp_path):
    """Exports of earlier versions hold no numbers of the whole map."""
    grid = make_grid()
    with np.load(written(tmp_path, grid, "npz"), allow_pickle=False) as file:
        kept = {name: file[name] for name in file.files if file[name].ndim == 3 or name in ("x_m", "y_m", "z_m")}
    np.savez(tmp_path / "old.npz", **kept)
    read, _ = read_export(tmp_path / "old.npz")
    np.testing.assert_allclose(read.ambient_uT, grid.mean_uT[grid.measured].mean(axis=0), rtol=1e-5)


def test_one_cell_is_a_map(tmp_path):
    grid = make_grid(shape=(1, 1, 1))
    grid.measured[:] = True
    read, _ = read_export(written(tmp_path, grid, "npz"))
    np.testing.assert_array_equal(read.mean_uT, grid.mean_uT)


def npz(**arrays) -> bytes:
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


WRONG_SIZE = npz(
    x_m=[0.0, 1.0], y_m=[0.0], z_m=[1.0], measured=[[[True]]], norm_ut=[[[1.0]]], norm_sd_ut=[[[1.0, 2.0]]]
)
PICKLED = npz(bx_ut=np.array([{"a": 1}], dtype=object))


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("map.npz", b"not a zip", "not a .npz file"),
        ("map.nc", b"not netcdf", "not a .nc file"),
        ("map.nc", b"\x89HDF\r\n\x1a\n" + bytes(100), "not a .nc file"),
        ("map.nc", b"CDF\x02" + bytes(3), "not a .nc file"),
        ("map.npz", PICKLED, "not a .npz file"),
        ("map.npz", npz(a=np.zeros(3)), "no map of Isodyn's"),
        ("map.npz", WRONG_SIZE, "not a whole map"),
        ("map.npz", npz(norm_ut=[[[1.0]]]), "not a whole map"),
        ("map.csv", b"x", ".nc or .npz"),
    ],
)
def test_foreign_files_are_refused(name, content, says, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InvalidInput, match=re_escape(says)):
        read_export(tmp_path / name)


def test_a_file_that_is_not_there_is_said_so(tmp_path):
    with pytest.raises(InvalidInput, match="No such file"):
        read_export(tmp_path / "nowhere.npz")


def re_escape(text: str) -> str:
    return text.replace(".", r"\.")
