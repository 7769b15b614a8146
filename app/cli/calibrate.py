"""`isodyn calibrate`: a device's magnetometer, from a file of readings taken while it was turned."""

from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from app.cli.client import DEFAULT_URL, Api, KeyOption, Url

__all__ = ["calibrate"]


def calibrate(
    device: Annotated[str, typer.Argument(help="a name for the device: its calibrations are counted")],
    readings: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="CSV with bx_ut,by_ut,bz_ut")],
    key: KeyOption,
    url: Url = DEFAULT_URL,
    method: Annotated[
        str, typer.Option(help="two_step, ellipsoid; turned level: modified_ellipsoid, swinging")
    ] = "two_step",
    latitude: Annotated[float | None, typer.Option(help="where it was turned, degrees")] = None,
    longitude: Annotated[float | None, typer.Option(help="degrees")] = None,
    height_m: Annotated[float, typer.Option(help="above the ellipsoid")] = 0.0,
    building: Annotated[str | None, typer.Option(help="instead: outside of this building, by its anchor")] = None,
    magnitude_ut: Annotated[float | None, typer.Option(help="instead: the field's magnitude")] = None,
    measured_at: Annotated[datetime | None, typer.Option(help="default: now")] = None,
) -> None:
    """Calibrate a device from readings in its own axes, uncalibrated, taken outdoors while it was turned.

    The other columns of the file do not matter. Afterwards name the device where its readings go:
    `isodyn ingest FLOOR FILES --device NAME`.
    """
    reference = {
        "latitude_deg": latitude, "longitude_deg": longitude, "height_m": height_m, "building_id": building,
        "magnitude_ut": magnitude_ut,
    }  # fmt: skip
    body: dict[str, Any] = {
        "device": device,
        "method": method,
        "b_ut": _read(readings),
        "reference": {name: value for name, value in reference.items() if value is not None},
    }
    if measured_at is not None:
        body["measured_at"] = measured_at.astimezone().isoformat()
    _show(Api(url, key).call("POST", "/v1/calibrations", json=body).json())


def _read(path: Path) -> list[list[float]]:
    """(n, 3) readings. Ends the command where the file has none."""
    import csv

    with path.open(newline="") as file:
        rows = csv.DictReader(file)
        missing = [name for name in ("bx_ut", "by_ut", "bz_ut") if name not in (rows.fieldnames or ())]
        if missing:
            raise typer.BadParameter(f"{path.name} lacks the column {', '.join(missing)}; it needs bx_ut,by_ut,bz_ut")
        try:
            return [[float(row[name]) for name in ("bx_ut", "by_ut", "bz_ut")] for row in rows]
        except (ValueError, TypeError) as error:
            raise typer.BadParameter(f"{path.name}, line {rows.line_num}: {error}") from error


def _show(made: dict[str, Any]) -> None:
    console = Console(highlight=False)
    console.print(
        f"[bold]{made['device']}[/bold] version {made['version']}, by {made['method']}: {made['samples']:,} readings, "
        f"{made['outliers']} left out, {made['residual_rms_ut']:.3f} uT rms left"
    )
    table = Table("parameter", "value", "sd", box=None)
    for name, value in made["parameters"].items():
        sd = made["parameter_sd"].get(name)
        table.add_row(name, f"{value:.4f}", "" if sd is None else f"{sd:.4f}")
    console.print(table)
    seen = made["coverage"]
    console.print(f"directions seen: {seen['cells_seen']} of {seen['cells']} parts of the {seen['kind']}")
    for line in made["advice"]:
        console.print(f"[yellow]advice[/yellow] {line}")
    console.print(f"calibration {made['id']}")
