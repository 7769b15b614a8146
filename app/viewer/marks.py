"""Positions in the scene: the likelihood of a window over a floor, its modes, the answer's ellipse, and paths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.viewer.asked import Ellipse, Likelihood, Marks, Mode, Path
from app.viewer.layers import ColourScale
from app.viewer.legends import Legend, legend
from app.viewer.mark_nodes import Ball, Line, Piece, Point, Words
from app.viewer.scene import Surface

__all__ = ["ESTIMATE_RGB", "LOWEST_NATS", "TRUTH_RGB", "blend_likelihood", "ellipse_points_m", "likelihood_legend",
           "mark_pieces"]  # fmt: skip

LOWEST_NATS = -20.0
_LIKELIHOOD = ColourScale(LOWEST_NATS, 0.0, "inferno")
TRUTH_RGB = (255, 255, 255)
ESTIMATE_RGB = (240, 120, 20)  # near Okabe and Ito's vermillion, brighter on a dimmed map
_ELLIPSE_SIGMAS = 2.4477  # holds 95 % of a Gaussian in the plane: the root of -2 ln 0.05
_ABOVE_M = {"paths": 0.12, "ellipses": 0.14, "modes": 0.16}


def mark_pieces(floor_id: str, height_m: float, marks: Marks, origin_m: Array) -> dict[str, Piece]:
    """What concerns one floor, over it, by name."""
    lift = _Lift(height_m, origin_m)
    pieces: dict[str, Piece] = {}
    for k, path in enumerate(p for p in marks.paths if p.floor_id == floor_id):
        pieces |= _path_pieces(f"path {k}", path, lift)
    for k, ellipse in enumerate(e for e in marks.ellipses if e.floor_id == floor_id):
        line = lift(ellipse_points_m(ellipse), _ABOVE_M["ellipses"])
        pieces[f"ellipse {k}"] = Line(line, ESTIMATE_RGB, 4.0)
    for k, mode in enumerate(m for m in marks.modes if m.floor_id == floor_id):
        pieces |= _mode_pieces(f"mode {k}", mode, lift)
    return pieces


def blend_likelihood(picture: Surface, likelihood: Likelihood, origin_m: Array) -> None:
    """Lay the likelihood over a layer's picture, fading out to nothing LOWEST_NATS below the best.

    Into the picture itself, because of two transparent planes the renderer shows one or the other.
    origin_m: what was subtracted from the picture's coordinates.
    """
    nats = np.array([[LOWEST_NATS if v is None else v for v in row] for row in likelihood.log_likelihood])
    rows, columns, _ = picture.rgba.shape
    place = tuple(
        _cells(middle, size, count, likelihood.origin_m[axis] - origin_m[axis], likelihood.resolution_m)
        for axis, (middle, size, count) in enumerate(
            zip(picture.centre_m[:2], picture.size_m, (columns, rows), strict=True)
        )
    )
    there = nats.shape[1] - 1 >= place[0], nats.shape[0] - 1 >= place[1]
    inside = ((place[1] >= 0) & there[1])[:, None] & ((place[0] >= 0) & there[0])[None, :]
    j, i = np.clip(place[1], 0, nats.shape[0] - 1), np.clip(place[0], 0, nats.shape[1] - 1)
    shown = np.where(inside, nats[np.ix_(j, i)], LOWEST_NATS)
    share = np.clip(1.0 - shown / LOWEST_NATS, 0.0, 1.0)[..., None] ** 0.5
    blended = share * _LIKELIHOOD.rgb(shown) + (1.0 - share) * picture.rgba[..., :3]
    picture.rgba[..., :3] = np.round(blended)
    picture.rgba[..., 3] = np.maximum(picture.rgba[..., 3], np.round(255.0 * share[..., 0])).astype(np.uint8)


def _cells(middle_m: float, size_m: float, count: int, origin_m: float, step_m: float) -> NDArray[np.intp]:
    """The index, along one axis, of the likelihood's cell that each cell of a picture lies in."""
    centres_m = middle_m - size_m / 2.0 + (np.arange(count) + 0.5) * size_m / count
    return np.round((centres_m - origin_m) / step_m).astype(np.intp)


def likelihood_legend() -> Legend:
    return legend("Log-likelihood of the window, less the best", "nats", _LIKELIHOOD)


def ellipse_points_m(ellipse: Ellipse, count: int = 64) -> Array:
    """The 95 % ellipse as a closed line (count, 2), building metres."""
    variances, axes = np.linalg.eigh(np.array(ellipse.covariance_m2))
    angle = np.linspace(0.0, 2.0 * np.pi, count)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    half_axes_m = _ELLIPSE_SIGMAS * np.sqrt(np.maximum(variances, 1e-6))
    return np.asarray(np.array(ellipse.position_m[:2]) + circle * half_axes_m @ axes.T)


@dataclass(frozen=True, slots=True)
class _Lift:
    """Points (n, 2) of the plan at a height, a little above the layer: local metres."""

    height_m: float
    origin_m: Array

    def __call__(self, p_m: Array, above_m: float) -> tuple[Point, ...]:
        lifted = np.column_stack([p_m, np.full(len(p_m), self.height_m + above_m)]) - self.origin_m
        return tuple((x, y, z) for x, y, z in lifted.tolist())


def _path_pieces(name: str, path: Path, lift: _Lift) -> dict[str, Piece]:
    if len(path.points_m) < 2:
        return {}
    line = lift(np.array(path.points_m)[:, :2], _ABOVE_M["paths"])
    truth = path.kind == "truth"
    return {name: Line(line, TRUTH_RGB if truth else ESTIMATE_RGB, 2.0 if truth else 4.0)}


def _mode_pieces(name: str, mode: Mode, lift: _Lift) -> dict[str, Piece]:
    """A ball, the larger the more probable, its share in words, and a short line the way it heads.

    One with a label is small, for its ellipse to be seen, and the label is high above it.
    """
    place_m = np.array(mode.position_m[:2])
    radius_m, words_m = (round(0.15 + 0.25 * mode.probability**0.5, 2), 0.5) if mode.label is None else (0.2, 1.2)
    pieces: dict[str, Piece] = {name: Ball(lift(place_m[None], _ABOVE_M["modes"])[0], ESTIMATE_RGB, radius_m)}
    if mode.label is not None or mode.probability >= 0.005:
        pieces[f"{name}/share"] = Words((0.0, 0.0, words_m), mode.label or f"{100 * mode.probability:.0f} %")
    if mode.heading_rad is not None:
        ahead_m = place_m + np.array([np.cos(mode.heading_rad), np.sin(mode.heading_rad)])
        line = lift(np.stack([place_m, ahead_m]), _ABOVE_M["modes"])
        pieces[f"{name} heading"] = Line(line, ESTIMATE_RGB, 5.0)
    return pieces
