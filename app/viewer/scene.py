"""A map and its walks as things to draw: plain arrays first (pure functions), then nodes of a viser scene.

Everything is float32 about a local origin subtracted in double precision, because viser sends coordinates in single
precision at best. A layer is drawn as a textured plane: its colours are exactly the legend's (lit or tone-mapped
meshes are not), its unmeasured cells are transparent, and a floor costs kilobytes.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from app.field.grid import FieldGrid
from app.geometry import Array, yaw_matrix
from app.viewer.layers import ColourScale
from app.viewer.source import PlacedPlan, Walk

if TYPE_CHECKING:
    from collections.abc import Sequence

    from viser import ArrowsHandle, ImageHandle, LineSegmentsHandle, SceneApi

__all__ = [
    "MAX_ARROWS",
    "MAX_POINTS",
    "WALK_COLOURS",
    "Arrows",
    "Box",
    "Surface",
    "arrow_view",
    "camera_pose",
    "draw_arrows",
    "draw_ground",
    "draw_lines",
    "draw_plan",
    "draw_surface",
    "field_arrows",
    "ground_cell_m",
    "local_origin_m",
    "plan_picture",
    "ring_segments",
    "suggested_arrow_spacing_m",
    "suggested_separation_m",
    "surface",
    "walk_segments",
    "walks_hide_the_field",
]

MAX_POINTS = 300_000
MAX_ARROWS = 20_000
_MAX_WALK_SEGMENTS = 20_000
_PLAN_PX = 2048
_USUAL_ARROWS = 320
_CLEARANCE_M = 0.04  # lifts lines and arrows off the plane they would otherwise flicker against

# Okabe and Ito's colours that stand out from viridis: distinguishable with every common colour vision.
WALK_COLOURS = ((255, 255, 255), (230, 159, 0), (213, 94, 0), (204, 121, 167), (86, 180, 233))


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """A layer as a picture lying in the plane: rgba (ny, nx, 4), row j towards +y; centre and size in local metres."""

    rgba: NDArray[np.uint8]
    centre_m: tuple[float, float, float]
    size_m: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Arrows:
    """Field arrows: ends (n, 2, 3) float32 local metres, magnitude_uT (n,), and the spacing they were thinned to."""

    ends_m: NDArray[np.float32]
    magnitude_uT: Array
    spacing_m: float


def local_origin_m(grids: Sequence[FieldGrid], rings_m: Sequence[Array] = (), walks: Sequence[Walk] = ()) -> Array:
    """(3,) what is subtracted from every coordinate: the middle of all there is in the plane, and z as it is."""
    corners = [np.reshape(grid.bounds_m, (2, 3))[:, :2] for grid in grids]
    corners += [ring[:, :2] for ring in rings_m if len(ring)]
    corners += [walk.p_building_m[:, :2] for walk in walks if len(walk.p_building_m)]
    if not corners:
        return np.zeros(3)
    low = np.min([c.min(axis=0) for c in corners], axis=0)
    high = np.max([c.max(axis=0) for c in corners], axis=0)
    return np.append((low + high) / 2, 0.0)


def camera_pose(
    grids: Sequence[FieldGrid], origin_m: Array, top: bool = False, spread_m: float = 0.0, aspect: float = 1.6
) -> tuple[Array, Array]:
    """Camera position and look-at point (3,) each, local metres: from the south, or from straight above.

    spread_m  how much higher the topmost floor is drawn than it is
    aspect    width of the picture by its height: a narrow one is looked at from farther away
    """
    bounds = np.array([grid.bounds_m for grid in grids] or [(-5.0, -5.0, 0.0, 5.0, 5.0, 0.0)])
    low, high = bounds[:, :3].min(axis=0) - origin_m, bounds[:, 3:].max(axis=0) - origin_m
    high[2] += spread_m
    target = (low + high) / 2
    width, depth, height = high - low
    if top:
        reach = 0.72 * max(width / aspect, depth, 2.0)
        return target + np.array([0.0, -1e-3, reach + height / 2]), target
    reach = (max(float(np.hypot(width, depth)), 2.0) * 0.57 + 0.45 * height) * max(1.0, 1.25 / aspect)
    slant = np.array([-0.12, -0.8, 0.8]) if height < 0.2 * depth else np.array([-0.2, -0.9, 0.75])
    return target + reach * slant / np.linalg.norm(slant) * 1.25, target


def surface(grid: FieldGrid, values: Array, scale: ColourScale, origin_m: Array, height_index: int = 0) -> Surface:
    """A layer's values (ny, nx), NaN where unmeasured, as a picture of at most MAX_POINTS cells.

    Every s-th cell is shown when there are more. Transparent cells carry their nearest neighbour's colour, so that
    the renderer's interpolation does not darken the rim.
    """
    stride = max(1, int(np.ceil(np.sqrt(values.size / MAX_POINTS))))
    shown = values[::stride, ::stride]
    measured = np.isfinite(shown)
    filled = shown
    if measured.any():
        nearest = distance_transform_edt(~measured, return_distances=False, return_indices=True)
        filled = shown[tuple(nearest)]
    alpha = np.where(measured, 255, 0).astype(np.uint8)
    cell = stride * grid.resolution_m
    ny, nx = shown.shape
    centre = np.array([grid.origin_m[0] + (nx - 1) * cell / 2, grid.origin_m[1] + (ny - 1) * cell / 2])
    x, y = centre - origin_m[:2]
    z = float(grid.heights_m[height_index] - origin_m[2])
    return Surface(np.dstack([scale.rgb(filled), alpha]), (float(x), float(y), z), (nx * cell, ny * cell))


def suggested_arrow_spacing_m(grids: Sequence[FieldGrid], height_index: int = 0) -> float:
    """A spacing in metres, a multiple of the cell size, giving some hundreds of arrows in all: few enough to read."""
    spacings = []
    for grid in grids:
        cells = max(1, int(grid.measured[min(height_index, len(grid.heights_m) - 1)].sum()))
        stride = max(1, int(np.ceil(np.sqrt(cells * min(len(grids), 3) / _USUAL_ARROWS))))
        spacings.append(grid.resolution_m * stride)
    return max(spacings, default=1.0)


def walks_hide_the_field(walks: Sequence[Walk], grids: Sequence[FieldGrid]) -> bool:
    """Whether the walks lie so close, under about four metres apart, that little of a layer is seen between them."""
    length_m = sum(float(np.linalg.norm(np.diff(w.p_building_m[:, :2], axis=0), axis=1).sum()) for w in walks)
    area_m2 = sum(float(grid.measured[0].sum()) * grid.resolution_m**2 for grid in grids)
    return bool(grids) and length_m > 0.25 * area_m2


def suggested_separation_m(grids: Sequence[FieldGrid]) -> float:
    """Metres to add between floors so that each can be seen over the one below: half metres, 0 for a single floor."""
    heights = sorted(float(grid.heights_m[0]) for grid in grids)
    if len(heights) < 2:
        return 0.0
    bounds = np.array([grid.bounds_m for grid in grids])
    depth = float(bounds[:, 4].max() - bounds[:, 1].min())
    gap = (heights[-1] - heights[0]) / (len(heights) - 1)
    return float(np.clip(np.round(2.0 * (0.85 * depth - gap)) / 2.0, 0.0, 40.0))


Box = tuple[float, float, float, float]
"""x_min, y_min, x_max, y_max in building metres."""


def field_arrows(
    grid: FieldGrid, origin_m: Array, spacing_m: float, height_index: int = 0, box_m: Box | None = None
) -> Arrows:
    """The mean field at every measured cell of a coarser lattice, at most MAX_ARROWS, standing on the map's plane.

    `box_m`: only those inside.

    The 99th percentile of the magnitudes spans 1.2 times the spacing. A level map knows only the vertical direction, so
    its arrows are vertical; a norm map has none.
    """
    components = {"vector": 3, "level": 2, "norm": 0}[grid.components]
    stride = max(1, round(spacing_m / grid.resolution_m))
    seen = grid.measured[height_index] if box_m is None else _inside(grid, box_m) & grid.measured[height_index]
    while components and seen[::stride, ::stride].sum() > MAX_ARROWS:
        stride += 1
    j, i = np.nonzero(seen[::stride, ::stride])
    if components == 0 or len(j) == 0:
        return Arrows(np.zeros((0, 2, 3), dtype=np.float32), np.zeros(0), stride * grid.resolution_m)
    j, i = j * stride, i * stride
    B_uT = grid.mean_uT[height_index, j, i].astype(np.float64)
    if components == 2:
        B_uT = np.stack([np.zeros(len(j)), np.zeros(len(j)), B_uT[:, 1]], axis=1)
    magnitude = np.linalg.norm(B_uT, axis=1)
    spacing = stride * grid.resolution_m
    direction = B_uT * (1.2 * spacing / max(float(np.percentile(magnitude, 99.0)), 1e-9))
    tail = np.empty_like(direction)
    tail[:, 0] = grid.origin_m[0] + i * grid.resolution_m - origin_m[0]
    tail[:, 1] = grid.origin_m[1] + j * grid.resolution_m - origin_m[1]
    tail[:, 2] = grid.heights_m[height_index] - origin_m[2] + _CLEARANCE_M + np.maximum(-direction[:, 2], 0.0)
    return Arrows(np.stack([tail, tail + direction], axis=1).astype(np.float32), magnitude, spacing)


def _inside(grid: FieldGrid, box_m: Box) -> NDArray[np.bool_]:
    """(ny, nx) the cells whose centres are in a box."""
    ny, nx = grid.measured.shape[1:]
    x_m = grid.origin_m[0] + grid.resolution_m * np.arange(nx)
    y_m = grid.origin_m[1] + grid.resolution_m * np.arange(ny)
    x_low, y_low, x_high, y_high = box_m
    return ((y_m >= y_low) & (y_m <= y_high))[:, None] & ((x_m >= x_low) & (x_m <= x_high))[None, :]


def arrow_view(position_m: Array, look_at_m: Array, resolution_m: float) -> tuple[float, Box]:
    """How far apart arrows stand for a camera (local metres), and the part of the floor they fill around its target.

    Both change in steps of two, so that a small move changes nothing: the nearer, the closer together.
    """
    distance_m = max(float(np.linalg.norm(position_m - look_at_m)), 1.0)
    spacing_m = resolution_m * 2.0 ** np.round(np.log2(max(distance_m / 24.0 / resolution_m, 1.0)))
    half_m = 48.0 * spacing_m
    x, y = np.round(look_at_m[:2] / (half_m / 2.0)) * (half_m / 2.0)
    return float(spacing_m), (float(x - half_m), float(y - half_m), float(x + half_m), float(y + half_m))


def walk_segments(
    walks: Sequence[Walk], origin_m: Array, colours_of: Sequence[NDArray[np.uint8]] | None = None
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Walks as line segments (m, 2, 3) and their colours (m, 2, 3), thinned when very long.

    colours_of: (n, 3) for the samples of each walk; without it each walk has one colour.
    """
    total = sum(len(walk.p_building_m) for walk in walks)
    stride = max(1, int(np.ceil(total / _MAX_WALK_SEGMENTS)))
    segments, colours = [np.zeros((0, 2, 3))], [np.zeros((0, 2, 3), dtype=np.uint8)]
    for k, walk in enumerate(walks):
        p = walk.p_building_m[::stride] - origin_m + np.array([0.0, 0.0, _CLEARANCE_M])
        segments.append(np.stack([p[:-1], p[1:]], axis=1))
        each = np.broadcast_to(np.array(WALK_COLOURS[k % len(WALK_COLOURS)], dtype=np.uint8), (len(p), 3))
        if colours_of is not None:
            each = colours_of[k][::stride]
        colours.append(np.stack([each[:-1], each[1:]], axis=1))
    return np.concatenate(segments).astype(np.float32), np.concatenate(colours)


def ring_segments(rings_m: Sequence[Array], elevation_m: float, origin_m: Array) -> NDArray[np.float32]:
    """The outline of a floor at its slab as closed line segments (m, 2, 3)."""
    segments = [np.zeros((0, 2, 3))]
    for ring in rings_m:
        p = np.column_stack([ring[:, :2], np.full(len(ring), elevation_m)]) - origin_m
        segments.append(np.stack([p, np.roll(p, -1, axis=0)], axis=1))
    return np.concatenate(segments).astype(np.float32)


def plan_picture(picture: bytes) -> NDArray[np.uint8]:
    """A floor plan's picture as (rows, columns, 3), at most _PLAN_PX a side, transparent places white.

    Opaque, because of two transparent planes the renderer shows one or the other.
    """
    from PIL import Image

    with Image.open(io.BytesIO(picture)) as image:
        image.thumbnail((_PLAN_PX, _PLAN_PX))
        shown = image.convert("RGBA")
        paper = Image.new("RGBA", shown.size, "white")
        return np.array(Image.alpha_composite(paper, shown).convert("RGB"))


def draw_plan(
    scene: SceneApi, name: str, picture: NDArray[np.uint8], plan: PlacedPlan, elevation_m: float, origin_m: Array
) -> ImageHandle:
    """Lay a floor plan on the slab: its lower left corner where it is placed, turned about that corner."""
    turn = yaw_matrix(plan.bearing_rad)
    corner_m = np.array([plan.x_m, plan.y_m, elevation_m])
    centre_m = corner_m + turn @ np.array([plan.width_m / 2.0, plan.height_m / 2.0, 0.0]) - origin_m
    half = plan.bearing_rad / 2.0
    return scene.add_image(
        name, picture, plan.width_m, plan.height_m, format="jpeg", cast_shadow=False, receive_shadow=False,
        wxyz=(float(np.cos(half)), 0.0, 0.0, float(np.sin(half))),
        position=(float(centre_m[0]), float(centre_m[1]), float(centre_m[2])),
    )  # fmt: skip


def draw_surface(scene: SceneApi, name: str, picture: Surface, visible: bool = True) -> ImageHandle:
    """Put a layer's picture into the scene."""
    return scene.add_image(
        name, picture.rgba, *picture.size_m, format="png", cast_shadow=False, receive_shadow=False,
        position=picture.centre_m, visible=visible,
    )  # fmt: skip


def draw_arrows(scene: SceneApi, name: str, arrows: Arrows, scale: ColourScale, visible: bool = True) -> ArrowsHandle:
    """Put arrows into the scene in the colour of |B|, lightened so that they stand off a surface of that colour."""
    thickness = arrows.spacing_m
    tint = 0.7 * scale.rgb(arrows.magnitude_uT) / 255.0 + 0.3
    linear = np.round(255.0 * tint**2.2).astype(np.uint8)  # viser 1.1 takes instance colours as linear light
    return scene.add_arrows(
        name, arrows.ends_m, linear, shaft_radius=0.04 * thickness,
        head_radius=0.12 * thickness, head_length=0.35 * thickness, visible=visible,
    )  # fmt: skip


def ground_cell_m(grids: Sequence[FieldGrid]) -> float:
    """The size of a ground square in metres: 1, 2, 5 or 10 times a power of ten, some dozen across the map."""
    bounds = np.array([grid.bounds_m for grid in grids] or [(0.0, 0.0, 0.0, 10.0, 10.0, 0.0)])
    span = float(np.max(bounds[:, 3:5].max(axis=0) - bounds[:, :2].min(axis=0)))
    power = 10.0 ** np.floor(np.log10(max(span, 1.0) / 12.0))
    return float(next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power * 12.0 >= span * 0.999))


def draw_ground(scene: SceneApi, name: str, grids: Sequence[FieldGrid], origin_m: Array, z_m: float) -> None:
    """A faint lattice under the lowest floor for scale; its lines lie on whole multiples of its cell."""
    cell = ground_cell_m(grids)
    bounds = np.array([grid.bounds_m for grid in grids] or [(-5.0, -5.0, 0.0, 5.0, 5.0, 0.0)])
    low = np.floor(bounds[:, :2].min(axis=0) / cell - 1.0) * cell
    high = np.ceil(bounds[:, 3:5].max(axis=0) / cell + 1.0) * cell
    x, y = (low + high) / 2 - origin_m[:2]
    width, height = high - low
    colour = (70, 76, 84)
    scene.add_grid(
        name, float(width), float(height), cell_size=cell, section_size=cell, cell_color=colour, section_color=colour,
        fade_strength=0.0, fade_distance=1e6, shadow_opacity=0.0,
        position=(float(x), float(y), z_m - float(origin_m[2])),
    )  # fmt: skip


def draw_lines(
    scene: SceneApi,
    name: str,
    segments_m: NDArray[np.float32],
    colours: NDArray[np.uint8] | tuple[int, int, int],
    width_px: float,
    visible: bool = True,
) -> LineSegmentsHandle:
    """Put line segments (m, 2, 3) into the scene, as wide on the screen at every distance."""
    return scene.add_line_segments(
        name, segments_m, np.asarray(colours), thickness=width_px, thickness_units="screen", visible=visible
    )
