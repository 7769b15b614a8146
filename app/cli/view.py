"""`isodyn view`: a map as a page to look at or a picture for a report, from a server or from an exported file."""

import os
import sys
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from app.cli.client import DEFAULT_URL, Api, Url
from app.cli.environment import say_refusals

__all__ = ["view"]

_SUFFIXES = (".nc", ".npz")


def view(
    source: Annotated[
        str, typer.Argument(metavar="MAP", help="a map's id, or a .nc or .npz file that `isodyn export` wrote")
    ],
    key: Annotated[str | None, typer.Option(envvar="ISODYN_KEY", help="an API key; a file needs none")] = None,
    url: Url = DEFAULT_URL,
    output: Annotated[Path | None, typer.Option(help="page to write; default: the map's name with .html")] = None,
    png: Annotated[Path | None, typer.Option(help="write a picture of one layer here instead of a page")] = None,
    layer: Annotated[str, typer.Option(help="layer of the picture, e.g. norm, sd, gradient")] = "norm",
    height_m: Annotated[float | None, typer.Option(help="height of the picture; default: the map's lowest")] = None,
    open_it: Annotated[
        bool | None, typer.Option("--open/--no-open", help="open the page; default: on a terminal with a display")
    ] = None,
) -> None:
    """Write a map as one HTML page that needs no network, and open it; with --png, as a picture."""
    if png is not None and output is not None:
        raise typer.BadParameter("--output names a page and --png a picture: give one of them")
    path = Path(source)
    is_file = path.suffix.lower() in _SUFFIXES or path.exists()
    if not is_file and key is None:
        raise typer.BadParameter(f"no such file; to ask {url} for map {source}, give --key or set ISODYN_KEY")
    with say_refusals():
        if is_file:
            content = _page_of_file(path) if png is None else _picture_of_file(path, layer, height_m)
        else:
            content = _page_of_server(Api(url, key or ""), source, png is not None, layer, height_m)
    written = png or output or Path(f"{path.stem if is_file else source}.html")
    written.write_bytes(content)
    print(f"{written}: {len(content):,} bytes")
    if png is None and (_somebody_looks() if open_it is None else open_it):
        webbrowser.open(written.resolve().as_uri())


def _page_of_server(api: Api, map_id: str, picture: bool, layer: str, height_m: float | None) -> bytes:
    if not picture:
        return bytes(api.call("GET", f"/v1/maps/{map_id}/view.html").content)
    asked = {"layer": layer} | ({} if height_m is None else {"height_m": str(height_m)})
    return bytes(api.call("GET", f"/v1/maps/{map_id}/heatmap.png", params=asked).content)


def _page_of_file(path: Path) -> bytes:
    from app.services.read_export import read_export
    from app.viewer.static_view import static_view_html

    grid, stored = read_export(path)
    return static_view_html(grid, title=path.stem, stored=stored).encode()


def _picture_of_file(path: Path, layer: str, height_m: float | None) -> bytes:
    from app.services.read_export import read_export
    from app.viewer.heatmap import heatmap_png
    from app.viewer.layers import check_layer, nearest_height

    grid, stored = read_export(path)
    check_layer(grid, layer, stored)
    return heatmap_png(grid, layer, height_index=nearest_height(grid, height_m), stored=stored)


def _somebody_looks() -> bool:
    """Whether stdout is a terminal on a machine with a display."""
    display = sys.platform in ("win32", "darwin") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    return sys.stdout.isatty() and display
