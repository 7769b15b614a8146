"""Nodes of what is marked on a floor. Only what changed from one picture to the next is sent, so nothing flickers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from app.viewer.scene import draw_lines

if TYPE_CHECKING:
    from viser import SceneApi, SceneNodeHandle

__all__ = ["Ball", "Line", "MarkNodes", "Piece", "Point", "Words"]

Point = tuple[float, float, float]
Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class Line:
    """A line through points, as wide on the screen at every distance."""

    points_m: tuple[Point, ...]
    rgb: Rgb
    width_px: float


@dataclass(frozen=True, slots=True)
class Ball:
    at_m: Point
    rgb: Rgb
    radius_m: float


@dataclass(frozen=True, slots=True)
class Words:
    """A label; of a ball's name and a slash, it goes with the ball."""

    at_m: Point
    text: str


Piece = Line | Ball | Words


class MarkNodes:
    """The nodes below one name. Pieces are known by their names: one that stays is moved, or drawn in place."""

    def __init__(self, scene: SceneApi, root: str) -> None:
        self._scene, self._root = scene, root
        self._drawn: dict[str, tuple[Piece, SceneNodeHandle]] = {}
        scene.add_frame(root, show_axes=False)

    def draw(self, pieces: Mapping[str, Piece]) -> None:
        """Show these pieces, and no others. A ball is named before what goes with it."""
        for name in sorted(self._drawn.keys() - pieces.keys(), reverse=True):  # what goes with a ball before the ball
            self._drawn.pop(name)[1].remove()
        for name, piece in pieces.items():
            before = self._drawn.get(name)
            if before is None or before[0] != piece:
                self._drawn[name] = (piece, self._put(name, piece, before))

    def _put(self, name: str, piece: Piece, before: tuple[Piece, SceneNodeHandle] | None) -> SceneNodeHandle:
        if before is not None and _is_moved(before[0], piece):
            before[1].position = piece.at_m  # type: ignore[union-attr]
            return before[1]
        return _add(self._scene, f"{self._root}/{name}", piece)


def _is_moved(before: Piece, now: Piece) -> bool:
    """Whether it is the same but for its place."""
    if isinstance(before, Ball) and isinstance(now, Ball):
        return (before.rgb, before.radius_m) == (now.rgb, now.radius_m)
    return isinstance(before, Words) and isinstance(now, Words) and before.text == now.text


def _add(scene: SceneApi, name: str, piece: Piece) -> SceneNodeHandle:
    """Put a piece into the scene, in place of one of its name."""
    if isinstance(piece, Line):
        line = np.array(piece.points_m, dtype=np.float32)
        return draw_lines(scene, name, np.stack([line[:-1], line[1:]], axis=1), piece.rgb, piece.width_px)
    if isinstance(piece, Words):
        return scene.add_label(name, piece.text, position=piece.at_m)
    return scene.add_icosphere(name, radius=piece.radius_m, color=piece.rgb, position=piece.at_m, cast_shadow=False)
