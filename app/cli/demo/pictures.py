"""Pictures of a demonstration: each floor's map with the fixes on it, and how errors compare with what was stated."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from app.cli.demo.journey import Answer, MappedFloor
from app.cli.demo.report import TECHNIQUES, Judged
from app.geometry import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure

__all__ = ["draw_errors", "draw_floor"]

# Okabe and Ito's colours, distinguishable with any colour vision.
ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#CC79A7"
_COLOURS = (SKY, ORANGE, GREEN, PURPLE, BLUE, VERMILION)
_MARKERS = ("o", "s", "^", "D", "v", "P")
_MOST_FIXES = 14
_UNMAPPED = "#e6e6e6"
_DPI = 130


def draw_floor(path: Path, floor: MappedFloor, answers: list[Answer]) -> None:
    """The map of |B| with unseen walks, their fixes and 95 % circles; beside it the stated uncertainty and surveys."""
    extent = _extent(floor)
    wide = (extent[1] - extent[0]) / (extent[3] - extent[2])
    figure = _figure(13.0, float(np.clip(4.9 / wide + 1.5, 3.6, 9.0)))
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    norm, sd = _norm_and_sd_uT(floor)
    _show(figure, left, norm, extent, "viridis", "|B| (µT)")
    _draw_fixes(left, floor, answers)
    _legend(figure)
    left.set_title(f"{floor.name}: mapped field, unseen walks and where they were located", fontsize=10)
    _show(figure, right, sd, extent, "cividis", "stated sd of |B| (µT)")
    for track in floor.tracks_m:
        right.plot(track[:, 0], track[:, 1], color="white", lw=0.5, alpha=0.55)
    right.set_title(f"{floor.name}: stated uncertainty and the {len(floor.tracks_m)} surveys", fontsize=10)
    margin = 0.02 * max(extent[1] - extent[0], extent[3] - extent[2])
    for axes in (left, right):
        axes.set(xlabel="x (m)", xlim=(extent[0] - margin, extent[1] + margin))
        axes.set(aspect="equal", ylim=(extent[2] - margin, extent[3] + margin))
        _scale_bar(axes, extent)
    left.set_ylabel("y (m)")
    figure.savefig(path, dpi=_DPI)


def draw_errors(path: Path, judged: list[Judged], title: str) -> None:
    """True error against stated radius, window by window, and the share of windows within a distance per technique."""
    figure = _figure(13.0, 5.6)
    left, right = figure.subplots(1, 2)
    _draw_calibration(left, [each for each in judged if each.technique == "posterior"])
    _draw_shares(right, judged)
    figure.suptitle(title, fontsize=11)
    figure.savefig(path, dpi=_DPI)


def _figure(width_in: float, height_in: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained")


def _extent(floor: MappedFloor) -> tuple[float, float, float, float]:
    x, y = floor.layers["x_m"], floor.layers["y_m"]
    half = 0.5 * floor.map["resolution_m"]
    return float(x[0] - half), float(x[-1] + half), float(y[0] - half), float(y[-1] + half)


def _norm_and_sd_uT(floor: MappedFloor) -> tuple[Array, Array]:
    """|B| of the mean and its standard deviation to first order, (ny, nx), NaN where unmeasured."""
    names = floor.quality["components"]
    mean = np.stack([floor.layers[f"{name}_ut"][0] for name in names], axis=-1)
    sd = np.stack([floor.layers[f"{name}_sd_ut"][0] for name in names], axis=-1)
    norm = np.linalg.norm(mean, axis=-1)
    return norm, np.linalg.norm(mean * sd, axis=-1) / norm


def _show(
    figure: "Figure", axes: "Axes", values: Array, extent: tuple[float, float, float, float], colours: str, label: str
) -> None:
    low, high = np.nanquantile(values, [0.01, 0.99])
    image: Any = axes.imshow(values, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high)
    figure.colorbar(image, ax=axes, label=label, shrink=0.85, extend="both")
    axes.set_facecolor(_UNMAPPED)


def _draw_fixes(axes: "Axes", floor: MappedFloor, answers: list[Answer]) -> None:
    """Windows whose truth is on this floor, clear fixes and long ones first; on a wrong floor only the truth shows."""
    from matplotlib.patches import Circle

    mine = [each for each in answers if _floor_of(each, floor)]
    longest = sorted(mine, key=lambda each: (each.fix["status"] != "fix", -each.question.length_m))[:_MOST_FIXES]
    for each in longest:
        axes.plot(*each.question.path_m.T, color="white", lw=1.4, alpha=0.9, solid_capstyle="round")
    for each in longest:
        belief = each.fix["posterior"]
        truth = each.question.truth_m
        axes.plot(truth[0], truth[1], "x", color="black", ms=7, mew=1.8, zorder=4)
        if belief is None or belief["floor_id"] != floor.floor_id:
            continue
        x, y = belief["position_m"][:2]
        axes.plot([truth[0], x], [truth[1], y], color=VERMILION, lw=1.0, zorder=3)
        axes.plot(x, y, "o", color=VERMILION, mec="white", mew=0.6, ms=4, zorder=5)
        axes.add_patch(Circle((x, y), belief["radius_95_m"], fill=False, color=VERMILION, lw=1.4, zorder=6))


def _floor_of(answer: Answer, floor: MappedFloor) -> bool:
    return bool(answer.question.floor == floor.index)


def _legend(figure: "Figure") -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    figure.legend(
        handles=[
            Line2D([], [], color="white", lw=2, label="walk of the window"),
            Line2D([], [], color="black", marker="x", ls="", mew=1.8, label="truth"),
            Line2D([], [], color=VERMILION, marker="o", mec="white", ls="", label="estimate"),
            Line2D([], [], color=VERMILION, marker="o", mfc="none", ms=11, ls="", label="95 % radius"),
            Patch(facecolor=_UNMAPPED, edgecolor="#808080", label="not mapped"),
        ],
        loc="outside lower center", ncols=5, fontsize=8, facecolor="#c8c8c8", framealpha=1.0,
    )  # fmt: skip


def _scale_bar(axes: "Axes", extent: tuple[float, float, float, float]) -> None:
    """A bar of 1, 2 or 5 times a power of ten metres, about a fifth of the width."""
    x0, x1, y0, y1 = extent
    wanted = (x1 - x0) / 5.0
    power = 10.0 ** np.floor(np.log10(wanted))
    length = float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= wanted))
    x, y = x0 + 0.03 * (x1 - x0), y0 + 0.04 * (y1 - y0)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.5}
    axes.plot([x, x + length], [y, y], color="black", lw=3, solid_capstyle="butt", zorder=6)
    axes.text(
        x + length / 2, y + 0.02 * (y1 - y0), f"{length:g} m", ha="center", va="bottom", fontsize=8, bbox=box, zorder=6
    )


def _draw_calibration(axes: "Axes", beliefs: list[Judged]) -> None:
    """One point per window, hollow unless the server called it a fix; below the line the stated radius held."""
    answered = [each for each in beliefs if each.error_m is not None]
    errors = np.array([np.inf if each.error_m is None else each.error_m for each in answered])
    radii = np.maximum([each.radius_95_m for each in answered], 0.01)
    finite = errors[np.isfinite(errors)]
    low, high = 0.5 * max(float(finite.min(initial=0.1)), 0.01), 2.0 * float(finite.max(initial=1.0))
    narrow, wide = 0.7 * float(radii.min(initial=1.0)), 1.5 * float(radii.max(initial=1.0))
    shown = np.where(np.isfinite(errors), np.maximum(errors, low), high / 1.25)
    lengths = np.array([each.answer.question.length_m for each in answered])
    called_fix = np.array([each.answer.fix["status"] == "fix" for each in answered], dtype=bool)
    for length_m, colour, marker in zip(np.unique(lengths), _COLOURS, _MARKERS, strict=False):
        style: dict[str, Any] = {"color": colour, "marker": marker, "ls": "", "ms": 6}
        for fix, face in ((True, colour), (False, "none")):
            mine = (lengths == length_m) & (called_fix == fix)
            axes.plot(radii[mine], shown[mine], mfc=face, **style)
        axes.plot([], [], label=f"{length_m:g} m walked", **style)
    line = [min(low, narrow), max(high, wide)]
    axes.plot(line, line, color="black", lw=1.0)
    axes.fill_between(line, line, line[0], color=GREEN, alpha=0.08, lw=0)
    axes.text(0.97, 0.04, "stated radius held", transform=axes.transAxes, ha="right", fontsize=9, color="#00664b")
    if len(finite) < len(errors):
        axes.axhline(high / 1.6, color="black", lw=0.6, ls=":")
        axes.text(narrow * 1.05, high / 1.3, "wrong floor", va="center", fontsize=8)
    axes.set(xscale="log", yscale="log", xlim=(narrow, wide), ylim=(low, high))
    _plain_ticks(axes.xaxis)
    _plain_ticks(axes.yaxis)
    axes.set(xlabel="stated 95 % radius (m)", ylabel="true error (m)")
    share = f"{np.mean(errors <= radii):.0%} of " if len(errors) else ""
    axes.set_title(f"{share}{len(answered)} windows within their stated 95 % radius", fontsize=10)
    if len(answered):
        axes.legend(loc="best", fontsize=8, title="hollow: not called a fix", title_fontsize=8)
    axes.grid(which="both", color="#d9d9d9", lw=0.4)


def _plain_ticks(axis: "Axis") -> None:
    """Logarithmic ticks at 1, 2 and 5, written out."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def _draw_shares(axes: "Axes", judged: list[Judged]) -> None:
    """Share of all windows asked that a technique placed within a distance; techniques that decline end lower."""
    names = {"ml": "maximum likelihood", "mlr": "likelihood ratio", "abl": "aggregate bins", "posterior": "posterior"}
    dashes: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.2)), "-.")
    finite = [each.error_m for each in judged if each.error_m is not None and np.isfinite(each.error_m)]
    low, high = (max(0.02, 0.8 * min(finite)), 1.3 * max(finite)) if finite else (0.1, 10.0)
    for technique, colour, dash in zip(TECHNIQUES, (BLUE, ORANGE, GREEN, VERMILION), dashes, strict=True):
        mine = [each for each in judged if each.technique == technique]
        errors = np.sort([each.error_m for each in mine if each.error_m is not None and np.isfinite(each.error_m)])
        share = np.arange(1, len(errors) + 1) / max(len(mine), 1)
        errors, share = np.append(errors, high), np.append(share, share[-1] if len(share) else 0.0)
        axes.step(errors, 100 * share, where="post", color=colour, ls=dash, lw=1.8, label=names[technique])
    axes.set(xscale="log", xlim=(low, high), ylim=(0, 101))
    axes.set(xlabel="true error (m)", ylabel="windows placed within that distance (%)")
    _plain_ticks(axes.xaxis)
    axes.set_title("Share of all windows asked; a technique that declines ends below 100 %", fontsize=10)
    axes.legend(loc="best", fontsize=8)
    axes.grid(which="both", color="#d9d9d9", lw=0.4)
