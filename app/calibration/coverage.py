"""Which directions of the field a calibration saw, in the sensor's axes, and how the device must turn to see the rest.

A circle is told by twelve headings of 30 degrees, a sphere by 24 cells of equal area: four zones of one height, six
cells each.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = [
    "CIRCLE_CELLS", "LARGEST_CONDITION", "SPHERE_CELLS", "OrientationCoverage", "circle_coverage", "refusal",
    "refuse_flat", "require_circle", "require_sphere", "sphere_coverage",
]  # fmt: skip

CIRCLE_CELLS = 12
SPHERE_CELLS = 24
LEAST_SPHERE_CELLS = 12
LARGEST_CONDITION = 50.0
"""Of the scaled derivatives by the parameters: 2 when every direction was seen, 17 for half a sphere, 20 for a belt of
20 degrees to both sides of a circle, 80 for one of 10 degrees."""

FLAT = 0.1
"""Readings whose least extent is smaller than this part of the largest lie in a plane."""

_ZONES, _SECTORS = 4, 6
_NEAR_AXIS = np.cos(np.deg2rad(45.0))
_AXES = ("+x", "-x", "+y", "-y", "+z", "-z")


@dataclass(frozen=True, slots=True)
class OrientationCoverage:
    """cells_seen of cells; unseen_axes such as `+z`: no direction within 45 degrees of it; condition of the fit."""

    kind: Literal["circle", "sphere"]
    cells_seen: int
    cells: int
    unseen_axes: tuple[str, ...]
    condition: float

    @property
    def fraction(self) -> float:
        """Of the cells, those seen."""
        return self.cells_seen / self.cells

    @property
    def advice(self) -> tuple[str, ...]:
        """What rotation is missing, in words for whoever holds the device; empty when nothing is."""
        if self.kind == "circle":
            missing = self.cells - self.cells_seen
            whole = "turn the device level through at least one whole circle, better three, at an even pace"
            return (f"{missing} of {self.cells} headings of 30 degrees were not seen: {whole}",) if missing else ()
        if self.unseen_axes:
            return tuple(_how_to_see(axis) for axis in self.unseen_axes)
        if self.cells_seen < 0.8 * self.cells:
            return (
                f"{self.cells - self.cells_seen} of {self.cells} parts of the sphere of directions were not seen: "
                "turn the device slowly about each of its three axes, two whole turns each",
            )
        return ()


def circle_coverage(directions: Array, condition: float) -> OrientationCoverage:
    """Of corrected horizontal directions (n, 2), unit vectors in the sensor's x and y."""
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    cell = np.floor((angle + np.pi) / (2 * np.pi) * CIRCLE_CELLS).astype(np.int64) % CIRCLE_CELLS
    flat = np.column_stack([directions, np.zeros(len(directions))])
    unseen = tuple(axis for axis in _unseen_axes(flat) if axis[1] != "z")
    return OrientationCoverage("circle", len(np.unique(cell)), CIRCLE_CELLS, unseen, condition)


def sphere_coverage(directions: Array, condition: float) -> OrientationCoverage:
    """Of corrected directions (n, 3), unit vectors in the sensor's axes."""
    zone = np.clip(np.floor((directions[:, 2] + 1.0) / 2.0 * _ZONES), 0, _ZONES - 1).astype(np.int64)
    angle = np.arctan2(directions[:, 1], directions[:, 0])
    sector = np.floor((angle + np.pi) / (2 * np.pi) * _SECTORS).astype(np.int64) % _SECTORS
    seen = len(np.unique(zone * _SECTORS + sector))
    return OrientationCoverage("sphere", seen, SPHERE_CELLS, _unseen_axes(directions), condition)


def require_circle(coverage: OrientationCoverage) -> None:
    """InvalidInput unless every heading was seen (Shockley, 3.6, step 1)."""
    if coverage.cells_seen < coverage.cells:
        raise refusal("The headings seen are not a whole circle", coverage.advice)


def require_sphere(coverage: OrientationCoverage) -> None:
    """InvalidInput where a three-dimensional fit is not determined (Shockley, L609; 3.6, step 9)."""
    if coverage.condition > LARGEST_CONDITION or coverage.cells_seen < LEAST_SPHERE_CELLS:
        seen = f"{coverage.cells_seen} of {coverage.cells} parts of the sphere, condition {coverage.condition:.0f}"
        raise refusal(f"The directions seen do not determine a calibration of three axes ({seen})", coverage.advice)


def refuse_flat(B_uT: Array) -> None:
    """InvalidInput where readings (n, 3) lie in a plane, whatever the sensor: a circle is no sphere.

    The design of a conic in x, y and z has rank 5 there (Shockley, 3.6, step 9).
    """
    extent, axes = np.linalg.svd(B_uT - np.median(B_uT, axis=0), full_matrices=False)[1:]
    if extent[-1] >= FLAT * extent[0]:
        return
    normal = axes[-1]
    k = int(np.argmax(np.abs(normal)))
    missing = [f"{sign}{'xyz'[k]}" for sign in "+-"]
    raise refusal("All directions lie in one plane, so a calibration of three axes is not determined",
           [_how_to_see(axis) for axis in missing])  # fmt: skip


def refusal(message: str, advice: tuple[str, ...] | list[str], location: str = "B_uT") -> InvalidInput:
    """The error to raise, with what to do about it."""
    advice = list(advice) or ["turn the device slowly about each of its three axes, away from steel"]
    return InvalidInput(f"{message}. What to do: {'; '.join(advice)}.", *(Fault(location, each) for each in advice))


def _unseen_axes(directions: Array) -> tuple[str, ...]:
    along = np.column_stack([directions, -directions]).max(axis=0)  # (6,): +x +y +z -x -y -z
    nearest = dict(zip(("+x", "+y", "+z", "-x", "-y", "-z"), along, strict=True))
    return tuple(axis for axis in _AXES if nearest[axis] < _NEAR_AXIS)


def _how_to_see(axis: str) -> str:
    return (
        f"directions around {axis} of the sensor were not seen: tilt the device until its {axis[1]} axis lies along "
        f"the field (steeply down over most of the Earth), {axis} end {'first' if axis[0] == '+' else 'last'}"
    )
