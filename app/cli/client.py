"""`isodyn ingest`, `isodyn locate` and `isodyn export`: the API from the command line, over HTTP."""

import gzip
import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

__all__ = ["DEFAULT_URL", "Api", "KeyOption", "Url", "export", "ingest", "locate"]

Url = Annotated[str, typer.Option(envvar="ISODYN_URL", help="where the server is")]
KeyOption = Annotated[str, typer.Option(envvar="ISODYN_KEY", help="an API key, isd_...")]
DEFAULT_URL = "http://127.0.0.1:8300"
FORMATS = {".csv": "csv", ".parquet": "parquet", ".ndjson": "ndjson", ".txt": "indoor-location-2020"}


class Api:
    """A server and a key; every refusal ends the command with the server's own sentence."""

    def __init__(self, url: str, key: str) -> None:
        import httpx

        self._http = httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=300)
        self._unreachable = httpx.TransportError
        self.url = url

    def call(self, method: str, path: str, **arguments: Any) -> Any:
        """The response of one request. Ends the command on a transport error or a problem."""
        console = Console(stderr=True, highlight=False)
        try:
            response = self._http.request(method, path, **arguments)
        except self._unreachable as error:
            console.print(f"[red]{self.url} cannot be reached[/red] ({error}); is `isodyn serve` running?")
            raise typer.Exit(2) from error
        if response.status_code >= 400:
            console.print(f"[red]{response.status_code}[/red] {_sentence(response)}")
            raise typer.Exit(1)
        return response


def ingest(
    floor_id: Annotated[str, typer.Argument(help="the floor the walks belong to")],
    files: Annotated[list[Path], typer.Argument(exists=True, dir_okay=False, help="survey files, also .gz")],
    key: KeyOption,
    url: Url = DEFAULT_URL,
    format: Annotated[str | None, typer.Option(help="default: by the file's ending")] = None,
    frame: Annotated[str, typer.Option(help="building, level or norm")] = "building",
    session: Annotated[
        str | None, typer.Option(help="label of the sensor's calibration session, for files with quaternions")
    ] = None,
    device: Annotated[str | None, typer.Option(help="whose newest calibration is applied to the readings")] = None,
    wait: Annotated[bool, typer.Option(help="wait until the map is built")] = True,
) -> None:
    """Upload surveys to a floor, and wait for its map."""
    api = Api(url, key)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    told = {name: value for name, value in (("session", session), ("device", device)) if value}
    job = None
    with Progress(*columns, console=Console(stderr=True)) as progress:
        uploading = progress.add_task("uploading", total=len(files))
        for file in files:
            packed = file.suffix == ".gz"
            kind = format or FORMATS.get(Path(file.stem).suffix if packed else file.suffix)
            if kind is None:
                raise typer.BadParameter(f"{file.name}: no known ending ({', '.join(FORMATS)}); give --format")
            answer = api.call(
                "POST",
                f"/v1/floors/{floor_id}/surveys",
                params={"format": kind, "frame": frame, "name": file.name} | told,
                headers={"Content-Encoding": "gzip"},
                content=file.read_bytes() if packed else gzip.compress(file.read_bytes()),
            ).json()
            job = answer["job"] or job
            progress.advance(uploading)
        if job is not None and wait:
            fitting = progress.add_task("mapping", total=100)
            while job["status"] in ("accepted", "running"):
                time.sleep(0.5)
                job = api.call("GET", f"/v1/jobs/{job['id']}").json()
                progress.update(fitting, completed=job["progress"], description=job["message"])
    if job is not None:
        print(json.dumps(job, indent=2))
        raise typer.Exit(0 if job["status"] in ("successful", "accepted", "running") else 1)


def locate(
    building_id: Annotated[str, typer.Argument(help="the building to search")],
    window: Annotated[Path, typer.Argument(exists=True, dir_okay=False, help="JSON: a window, or a whole request")],
    key: KeyOption,
    url: Url = DEFAULT_URL,
) -> None:
    """Locate a window of samples and print the fix."""
    body = json.loads(window.read_text())
    body = body if "window" in body else {"window": body}
    print(json.dumps(Api(url, key).call("POST", f"/v1/buildings/{building_id}/locate", json=body).json(), indent=2))


def export(
    map_id: Annotated[str, typer.Argument(help="the map")],
    output: Annotated[Path, typer.Argument(help="file to write")],
    key: KeyOption,
    url: Url = DEFAULT_URL,
    format: Annotated[str, typer.Option(help="netcdf, zarr, npz, covjson or csv")] = "netcdf",
    localizability: Annotated[bool, typer.Option(help="also gradient norms, information, expected error")] = False,
) -> None:
    """Write a map as a file for other tools."""
    asked = {"format": format, "localizability": localizability}
    answer = Api(url, key).call("GET", f"/v1/maps/{map_id}/export", params=asked)
    output.write_bytes(answer.content)
    print(f"{output}: {len(answer.content):,} bytes")


def _sentence(response: Any) -> str:
    try:
        problem = response.json()
        faults = [f"\n  {fault['location']}: {fault['reason']}" for fault in problem.get("errors", [])]
        return str(problem["detail"]) + "".join(faults)
    except (ValueError, KeyError):
        return str(response.text[:500])
