"""Readings as moves: what carries particles from one reading to the next, and what is compared there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.field.samples import Components
from app.geometry import Array, horizontal_and_vertical, yaw_matrix
from app.positioning.window import WindowFrame
from app.tracking.options import TrackOptions
from app.tracking.particles import Advance
from app.tracking.places import Places
from app.tracking.recent import Reading

__all__ = ["Moves", "features_of", "move_between", "offset_variance_uT2", "window_moves"]

STRAIGHT_S = 1.0  # how long somebody walks straight on, of whom nothing is known


@dataclass(frozen=True, slots=True, eq=False)
class Moves:
    """The moves of a window, the first of them to its first reading: no way at all."""

    advances: tuple[Advance, ...]
    offset_variance_uT2: float


def offset_variance_uT2(places: Places, options: TrackOptions) -> float:
    """Of what is not known of the sensor's offset, and of errors that a whole walk shares."""
    own = options.bias_sd_uT**2 * float(np.mean(np.square(places.scale)))
    return own + places.structure.constant_share * places.typical_variance_uT2


def features_of(B_uT: Array, components: Components, frame: WindowFrame, scale: Array) -> Array:
    """(c,) scaled features of a reading in the track's frame."""
    if frame == "norm" or components == "vector":
        return np.asarray(scale * np.asarray(B_uT, dtype=np.float64).reshape(-1))
    if components == "level":
        return np.asarray(scale * horizontal_and_vertical(B_uT))
    return np.asarray(scale * np.linalg.norm(B_uT))


def move_between(
    before: Reading | None, reading: Reading, frame: WindowFrame, places: Places, options: TrackOptions
) -> Advance:
    """The move from one reading to the next (from None: no way at all)."""
    moved = np.zeros(3) if before is None else reading.displacement_m - before.displacement_m
    distance = float(np.linalg.norm(moved)) + reading.unseen_m
    root = float(np.sqrt(distance))
    strayed = root * options.position_walk_m
    if reading.unseen_m > 0.0:
        strayed = float(np.sqrt(reading.unseen_m * options.speed_m_s * STRAIGHT_S))
    turned = frame != "building"
    vectors = places.components == "vector"
    if reading.device_to_frame is not None:
        turn = reading.device_to_frame.T
    else:
        turn = yaw_matrix(-reading.yaw_rad) if vectors and turned else np.eye(3)
    kept_course, kept_scale = np.exp(-distance / options.course_m), np.exp(-distance / options.scale_m)
    walk = np.array([
        root * options.heading_walk_rad if turned else 0.0, strayed,
        kept_course, options.course_sd_rad * np.sqrt(1.0 - kept_course**2),
        kept_scale, options.step_scale_sd * np.sqrt(1.0 - kept_scale**2),
    ])  # fmt: skip
    noise = options.noise_uT**2 * float(np.mean(np.square(places.scale))) / reading.samples
    return Advance(
        moved_m=moved[:2], distance_m=distance, risen_m=float(moved[2]),
        features_uT=features_of(reading.B_uT, places.components, frame, places.scale), noise_uT2=max(noise, 1e-6),
        turn=turn, walk=walk, turns=vectors and frame == "level",
    )  # fmt: skip


def window_moves(readings: Sequence[Reading], frame: WindowFrame, places: Places, options: TrackOptions) -> Moves:
    """The moves of a window's readings."""
    befores = (None, *readings[:-1])
    return Moves(
        tuple(
            move_between(before, reading, frame, places, options)
            for before, reading in zip(befores, readings, strict=True)
        ),
        offset_variance_uT2(places, options),
    )
