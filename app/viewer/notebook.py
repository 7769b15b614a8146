"""A map in a notebook: `show_map(...)` as the last line of a cell shows the static view, or a picture in print."""

from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from app.field.grid import FieldGrid
from app.services.read_export import read_export
from app.viewer.heatmap import heatmap_png
from app.viewer.layers import NONE_STORED, StoredLayers

__all__ = ["MapInNotebook", "show_map"]


@dataclass(frozen=True, slots=True, eq=False)
class MapInNotebook:
    """A map that a notebook knows how to show: as a page in a frame, or as a picture of `layer` where pages are not."""

    grid: FieldGrid
    stored: StoredLayers = field(default_factory=lambda: NONE_STORED)
    title: str = "Magnetic map"
    layer: str = "norm"
    height_index: int = 0
    frame_height_px: int = 640

    def html(self) -> str:
        """The static view as one page."""
        from app.viewer.static_view import static_view_html  # viser is loaded only when somebody looks

        return static_view_html(self.grid, title=self.title, height_index=self.height_index, stored=self.stored)

    def _repr_html_(self) -> str:
        """The page in a frame that may run its own scripts and do nothing else."""
        return (
            f'<iframe srcdoc="{escape(self.html())}" sandbox="allow-scripts" title="{escape(self.title)}" width="100%" '
            f'height="{self.frame_height_px}" style="border:0;display:block"></iframe>'
        )

    def _repr_png_(self) -> bytes:
        """A picture of one layer, for exports of the notebook without scripts."""
        return heatmap_png(self.grid, self.layer, height_index=self.height_index, stored=self.stored)

    def __repr__(self) -> str:
        nz, ny, nx = self.grid.measured.shape
        cells = f"{nx} x {ny} cells of {self.grid.resolution_m:g} m, heights: {nz}"
        return f"<{self.title}: {self.grid.components} map, {cells}>"


def show_map(
    source: FieldGrid | Path | str,
    title: str | None = None,
    layer: str = "norm",
    height_index: int = 0,
    stored: StoredLayers = NONE_STORED,
    frame_height_px: int = 640,
) -> MapInNotebook:
    """A grid, or the path of an exported .nc or .npz file, as something a notebook shows.

    `layer`: of the picture; the page has them all. `stored`: layers of the fit, of a grid; a file brings its own.
    Raises InvalidInput for a file that is not an exported map.
    """
    if isinstance(source, FieldGrid):
        return MapInNotebook(source, stored, title or "Magnetic map", layer, height_index, frame_height_px)
    path = Path(source)
    grid, layers = read_export(path)
    return MapInNotebook(grid, layers, title or path.stem, layer, height_index, frame_height_px)
