"""Tracks as curves: how many ends are within a distance, and how the error changes along the walk, filter by filter."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from app.geometry import Array
from app.services.track_scores import JudgedTrack

__all__ = ["error_along_m", "plot_tracks"]

FARTHEST_M = 20.0
LEAST_WALKS = 3  # for quartiles along the walk


def plot_tracks(file: Path, tracks: Sequence[JudgedTrack]) -> None:
    """Two panels for covered walks (all of them where none is covered). The file's ending decides the format."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = [track for track in tracks if track.covered] or list(tracks)
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    FigureCanvasAgg(figure)
    ends, along = figure.subplots(1, 2)
    for k, name in enumerate(dict.fromkeys(track.filter for track in shown)):
        mine = [track for track in shown if track.filter == name]
        told = "" if mine[0].told == "nothing" else f" (told {mine[0].told})"
        _ends(ends, mine, f"{name}{told}", f"C{k}")
        _along(along, mine, f"C{k}")
    walks = len({(track.floor_id, track.walk) for track in shown})
    ends.set(xlabel="error at the end of the walk, m", ylabel="share of walks", xlim=(0, FARTHEST_M), ylim=(0, 1),
             title=f"{walks} {'covered ' if shown[0].covered else ''}walks")  # fmt: skip
    along.set(xlabel="distance walked, m", ylabel="error, m", yscale="log", ylim=(0.1, 300),
              title="median and quartiles along the walk")  # fmt: skip
    ends.legend(fontsize="small")
    for axes in (ends, along):
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=90)


def _ends(axes: Any, tracks: Sequence[JudgedTrack], label: str, colour: str) -> None:
    error_m = np.sort([track.end_error_m for track in tracks])
    x = np.concatenate([[0.0], error_m[error_m <= FARTHEST_M], [FARTHEST_M]])
    y = np.concatenate([np.arange(len(x) - 1), [len(x) - 2]]) / len(error_m)
    axes.step(x, y, where="post", label=label, color=colour, linestyle=_line(tracks))


def _along(axes: Any, tracks: Sequence[JudgedTrack], colour: str) -> None:
    low, middle, high = np.minimum(error_along_m(tracks), 1e3)
    at_m = np.arange(len(middle))
    axes.plot(at_m, middle, color=colour, linestyle=_line(tracks))
    axes.fill_between(at_m, low, high, color=colour, alpha=0.12, linewidth=0)


def error_along_m(tracks: Sequence[JudgedTrack]) -> Array:
    """(3, n) quartiles of the error at 0, 1, 2 ... metres walked, as far as enough walks go; infinite: said nothing."""
    lengths = sorted((len(track.error_m) for track in tracks), reverse=True)
    longest = lengths[min(LEAST_WALKS, len(lengths)) - 1]
    columns = [[track.error_m[k] for track in tracks if len(track.error_m) > k] for k in range(longest)]
    return np.array([np.percentile(column, [25, 50, 75], method="higher") for column in columns]).T


def _line(tracks: Sequence[JudgedTrack]) -> str:
    return "-" if tracks[0].told == "nothing" else "--"
