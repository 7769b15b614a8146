"""Exports, read back by libraries that had no part in writing them, against what the map itself answers."""

import io
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import netCDF4
import numpy as np
import pandas as pd
import pytest
import xarray as xr
import zarr
from covjson_pydantic.coverage import Coverage

from app.field.expected_error import WindowModel, expected_error_m, point_information
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components
from app.services.export_map import MEDIA_TYPES, ExportFormat, export_map

SHA256 = "5eed" * 16
FORMATS = list(MEDIA_TYPES)


def make_grid(components: Components = "vector", shape: tuple[int, int, int] = (3, 9, 14), seed: int = 0) -> FieldGrid:
    """Random values, a third of the cells unmeasured; heights that are not evenly spaced."""
    rng = np.random.default_rng(seed)
    c = len(COMPONENT_NAMES[components])
    values = rng.normal(30.0, 9.0, (*shape, c)).astype(np.float32)
    return FieldGrid(
        components=components,
        origin_m=(-1.3, 40.1),
        resolution_m=0.3,
        heights_m=np.array([0.4, 1.2, 2.9, 4.0])[: shape[0]],
        mean_uT=values,
        sd_uT=rng.uniform(0.1, 2.0, values.shape).astype(np.float32),
        gradient_uT_per_m=rng.normal(0.0, 3.0, (*values.shape, 2)).astype(np.float32),
        measured=rng.uniform(size=shape) > 0.3,
        ambient_uT=np.arange(1.0, c + 1.0),
        prior_sd_uT=np.full(c, 9.0),
        noise_sd_uT=np.full(c, 0.5),
        error_correlation_m=2.5,
    )


def make_layers(grid: FieldGrid) -> dict[str, np.ndarray]:
    """Coverage everywhere; conflict known in the west only."""
    coverage = np.random.default_rng(3).integers(0, 5, grid.measured.shape).astype(np.float32)
    conflict = np.where(np.arange(grid.measured.shape[2]) < 5, coverage / 4.0, np.nan).astype(np.float32)
    return {"conflict": conflict, "coverage": coverage}


def read(format: ExportFormat, data: bytes, folder: Path) -> xr.Dataset:
    """An export as a dataset on x, y and z, by a reader of its own."""
    if format == "netcdf":
        return xr.open_dataset(xr.backends.NetCDF4DataStore(netCDF4.Dataset("map.nc", memory=data)))
    if format == "zarr":
        (folder / "map.zarr.zip").write_bytes(data)
        return xr.open_zarr(zarr.storage.ZipStore(folder / "map.zarr.zip", mode="r"), consolidated=True)
    if format == "csv":
        return pd.read_csv(io.BytesIO(data)).set_index(["z_m", "y_m", "x_m"]).to_xarray().rename(_AXES_OF_COLUMNS)
    if format == "npz":
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = dict(file)
        axes = {axis: arrays.pop(f"{axis}_m") for axis in "zyx"}
        return xr.Dataset(
            {name: (("z", "y", "x"), values) for name, values in arrays.items() if values.ndim == 3}, axes
        )
    coverage = Coverage.model_validate_json(data)
    ranges = {
        name: (r.axisNames, np.array(r.values, dtype=float).reshape(r.shape)) for name, r in coverage.ranges.items()
    }
    return xr.Dataset(ranges, {axis: getattr(coverage.domain.axes, axis).values for axis in "zyx"})


_AXES_OF_COLUMNS = {"z_m": "z", "y_m": "y", "x_m": "x"}


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
@pytest.mark.parametrize("format", FORMATS)
def test_an_export_read_and_interpolated_elsewhere_is_the_field_of_the_map(
    format: ExportFormat, components: Components, tmp_path: Path
) -> None:
    grid = make_grid(components)
    dataset = read(format, export_map(grid, format, SHA256, make_layers(grid)), tmp_path).load()
    x0, y0, z0, x1, y1, z1 = grid.bounds_m
    points_m = np.random.default_rng(1).uniform([x0, y0, z0], [x1, y1, z1], (3000, 3))
    asked = grid.at(points_m)
    points_m, known = points_m[asked.measured], asked.measured
    assert known.sum() > 100
    at = {axis: ("point", points_m[:, k]) for k, axis in enumerate("xyz")}
    for c, name in enumerate(grid.component_names):
        mean = dataset[f"{name}_ut"].interp(at)
        np.testing.assert_allclose(mean, asked.mean_uT[known, c], atol=2e-4)
        variance = (dataset[f"{name}_sd_ut"].astype(float) ** 2).interp(at)
        np.testing.assert_allclose(np.sqrt(variance), asked.sd_uT[known, c], atol=2e-4)
        for k, axis in enumerate("xy"):
            slope = dataset[f"d{name}_d{axis}_ut_per_m"].interp(at)
            np.testing.assert_allclose(slope, asked.gradient_uT_per_m[known, c, k], atol=2e-4)


@pytest.mark.parametrize("format", FORMATS)
def test_what_was_not_measured_is_missing(format: ExportFormat, tmp_path: Path) -> None:
    grid = make_grid()
    layers = make_layers(grid)
    dataset = read(format, export_map(grid, format, SHA256, layers), tmp_path)
    names = set(dataset.data_vars) - {"measured", "x_bnds", "y_bnds"}
    assert len(names) == 3 * 4 + 2
    for name in names - {"conflict"}:
        np.testing.assert_array_equal(np.isfinite(dataset[name].transpose("z", "y", "x")), grid.measured)
    for name, layer in layers.items():
        np.testing.assert_array_equal(dataset[name], np.where(grid.measured, layer, np.nan))
    if format != "csv":
        np.testing.assert_array_equal(dataset["measured"], grid.measured)


@pytest.mark.parametrize("format", FORMATS)
def test_what_tells_places_apart_comes_on_request(format: ExportFormat, tmp_path: Path) -> None:
    grid, window = make_grid(shape=(2, 60, 70)), WindowModel()
    usual = set(read(format, export_map(grid, format, SHA256), tmp_path).data_vars)
    dataset = read(format, export_map(grid, format, SHA256, localizability=True), tmp_path).transpose(
        "z", "y", "x", ...
    )
    expected = {
        "gradient_ut_per_m": np.linalg.norm(grid.gradient_uT_per_m, axis=(-2, -1)),
        "gradient_x_ut_per_m": np.linalg.norm(grid.gradient_uT_per_m[..., 0], axis=-1),
        "gradient_y_ut_per_m": np.linalg.norm(grid.gradient_uT_per_m[..., 1], axis=-1),
        "information_per_m2": np.stack([point_information(grid, k, 0.5) for k in (0, 1)]),
        "expected_error_m": np.stack([expected_error_m(grid, k, window) for k in (0, 1)]),
    }
    assert set(dataset.data_vars) - usual == set(expected)
    assert np.isfinite(expected["expected_error_m"]).sum() > 1000
    for name, values in expected.items():
        np.testing.assert_allclose(dataset[name], np.where(grid.measured, values, np.nan), rtol=1e-5, atol=6e-5)
    if format in ("netcdf", "zarr"):
        about = dataset["expected_error_m"].attrs
        assert about["units"] == "m"
        assert "a straight window of 10 m that ends here, 0.5 uT of noise, heading unknown" in about["long_name"]


@pytest.mark.parametrize("format", FORMATS)
def test_the_gradient_may_be_left_out_and_may_have_a_vertical_part(format: ExportFormat, tmp_path: Path) -> None:
    grid = make_grid("level")
    without = set(read(format, export_map(grid, format, SHA256, gradient=False), tmp_path).data_vars)
    values = {field.name: getattr(grid, field.name) for field in fields(grid)}
    upward = np.full((*grid.mean_uT.shape, 1), 2.5, np.float32)
    solid: Any = SimpleNamespace(**values | {
        "component_names": grid.component_names,
        "gradient_uT_per_m": np.concatenate([grid.gradient_uT_per_m, upward], axis=-1),
    })  # fmt: skip
    dataset = read(format, export_map(solid, format, SHA256), tmp_path)
    slopes = {f"d{name}_d{axis}_ut_per_m" for name in ("horizontal", "vertical") for axis in "xyz"}
    assert set(dataset.data_vars) - without == slopes
    rising = dataset["dvertical_dz_ut_per_m"].values
    assert set(rising[np.isfinite(rising)]) == {2.5}


@pytest.mark.parametrize("format", FORMATS)
def test_the_same_map_gives_the_same_bytes_also_in_threads(format: ExportFormat) -> None:
    grid = make_grid()
    first = export_map(grid, format, SHA256, make_layers(grid))
    with ThreadPoolExecutor(3) as pool:
        again = list(pool.map(lambda _: export_map(make_grid(), format, SHA256, make_layers(grid)), range(3)))
    assert again == [first] * 3
    assert export_map(make_grid(seed=1), format, SHA256) != first


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 3), (2, 600, 2)])
@pytest.mark.parametrize("format", FORMATS)
def test_a_map_of_one_cell_or_of_many_chunks_is_a_map(
    format: ExportFormat, shape: tuple[int, int, int], tmp_path: Path
) -> None:
    grid = make_grid("norm", shape)
    grid.measured[:] = True
    dataset = read(format, export_map(grid, format, SHA256), tmp_path)
    np.testing.assert_allclose(dataset["norm_ut"].transpose("z", "y", "x"), grid.mean_uT[..., 0], atol=6e-5)
    np.testing.assert_allclose(dataset["z"], grid.heights_m)


@pytest.mark.parametrize("format", ["netcdf", "zarr"])
def test_attributes_follow_the_cf_conventions(format: ExportFormat, tmp_path: Path) -> None:
    """CF-1.11: 2.6.2 (title, source), 3.1 (units), 3.4 (ancillary), 3.5 (flags), 4.3 (vertical), 7.1 (bounds)."""
    grid = make_grid("level")
    dataset = read(format, export_map(grid, format, SHA256, make_layers(grid)), tmp_path)
    assert dataset.attrs["Conventions"] == "CF-1.11"
    assert dataset.attrs["id"] == SHA256
    assert {"title", "source", "comment"} <= set(dataset.attrs)
    np.testing.assert_array_equal(dataset.attrs["noise_sd_ut"], grid.noise_sd_uT)
    np.testing.assert_array_equal(dataset.attrs["ambient_ut"], grid.ambient_uT)
    assert [dataset[axis].attrs["axis"] for axis in "xyz"] == ["X", "Y", "Z"]
    assert dataset["z"].attrs["positive"] == "up"
    for axis in "xy":
        edges = dataset[dataset[axis].attrs["bounds"]].values
        np.testing.assert_allclose(edges.mean(axis=1), dataset[axis])
        np.testing.assert_allclose(edges[1:, 0], edges[:-1, 1])
        np.testing.assert_allclose(np.diff(edges), grid.resolution_m)
    flags = dataset["measured"]
    assert flags.dtype == np.int8
    assert len(flags.attrs["flag_meanings"].split()) == len(flags.attrs["flag_values"]) == 2
    for name in set(dataset.data_vars) - {"measured", "x_bnds", "y_bnds"}:
        about = dataset[name].attrs
        units = "1" if name in ("coverage", "conflict") else "uT m-1" if name.startswith("d") else "uT"
        assert (about["units"], bool(about["long_name"])) == (units, True)
        assert set(about["ancillary_variables"].split()) <= set(dataset.data_vars)
        assert np.isnan(dataset[name].encoding.get("_FillValue", dataset[name].encoding.get("fill_value")))
    assert "vertical_sd_ut" in dataset["vertical_ut"].attrs["ancillary_variables"]


def test_coverage_json_says_what_and_in_which_unit_without_numbers_that_json_lacks() -> None:
    grid = make_grid("level")
    data = export_map(grid, "covjson", SHA256, make_layers(grid))
    raw = json.loads(data, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))
    coverage = Coverage.model_validate(raw)
    assert coverage.domain.domainType == "Grid"
    systems = {tuple(r["coordinates"]): r["system"]["type"] for r in raw["domain"]["referencing"]}
    assert systems == {("x", "y"): "ProjectedCRS", ("z",): "VerticalCRS"}
    symbols = {name: p.get("unit", {}).get("symbol", {}).get("value") for name, p in raw["parameters"].items()}
    assert symbols["vertical_ut"] == symbols["vertical_sd_ut"] == "uT"
    assert symbols["dvertical_dx_ut_per_m"] == "uT/m"
    assert symbols["conflict"] == "1"
    measured = raw["parameters"]["measured"]
    assert set(measured["categoryEncoding"]) == {each["id"] for each in measured["observedProperty"]["categories"]}
    assert raw["ranges"].keys() == raw["parameters"].keys()
    assert sum(v is None for v in raw["ranges"]["vertical_ut"]["values"]) == (~grid.measured).sum()
