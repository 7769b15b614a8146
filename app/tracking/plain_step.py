"""One step of a particle filter in plain numpy: the twin of `app.tracking.fused_step`, with random numbers given."""

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.tracking.cloud import EXACTLY, UNMAPPED_UT2, CellTable, Cloud, Step, Stepped, moments_of
from app.tracking.particle_filter import RESAMPLE_BELOW
from app.tracking.random_numbers import Float32

__all__ = ["step_plain"]


def step_plain(
    cloud: Cloud,
    table: CellTable,
    step: Step,
    noise: NDArray[np.floating],
    draw: float,
    resample_below: float = RESAMPLE_BELOW,
) -> Stepped:
    """Resample below that share of n, move with normals (4, n), look up, weigh; in the cloud's own precision."""
    told = step.numbers().astype(cloud.state.dtype)
    state, weight = cloud.state, cloud.weight
    total = float(weight.sum())
    resampled = total**2 < resample_below * len(weight) * float(weight @ weight) * EXACTLY
    if resampled:
        edge = np.cumsum(weight, dtype=np.float64)
        first = np.minimum(np.ceil(edge * (len(weight) / edge[-1]) - draw), len(weight)).astype(np.int64)
        state = state.take(np.repeat(np.arange(len(weight)), np.diff(first, prepend=0)), axis=1)
        weight = np.full_like(weight, 1.0 / len(weight))
    state = _moved(state, noise, told)
    weight = _weighed(weight, *_fitted(state, table, told))
    total = float(weight.sum(dtype=np.float64))
    diverged = not 0.0 < total < np.inf
    weight = np.full_like(weight, 1.0 / len(weight)) if diverged else weight * weight.dtype.type(1.0 / total)
    moments = moments_of(_weighted_sums(state, weight))
    return Stepped(Cloud(state, weight), moments, 1.0 / float(weight @ weight), resampled, diverged)


def _moved(state: Float32, noise: NDArray[np.floating], told: Float32) -> Float32:
    x, y, c, s, scale = state
    dx, dy, position_sd, heading_sd, scale_sd = told[:5]
    turn = heading_sd * noise[2]
    sine, cosine = np.sin(turn), np.cos(turn)
    c, s = c * cosine - s * sine, s * cosine + c * sine
    scale = scale + scale_sd * noise[3]
    moved = np.empty_like(state)
    moved[0] = x + scale * (c * dx - s * dy) + position_sd * noise[0]
    moved[1] = y + scale * (s * dx + c * dy) + position_sd * noise[1]
    moved[2], moved[3], moved[4] = c, s, scale
    return moved


def _fitted(moved: Float32, table: CellTable, told: Float32) -> tuple[Float32, NDArray[np.bool_]]:
    bx, by, bz, sensor = told[5:]
    record = table.record
    ny, nx, _ = record.shape
    u, v = (moved[0] - table.x0_m) * table.cells_per_m, (moved[1] - table.y0_m) * table.cells_per_m
    inside = (u >= 0) & (u <= nx - 1) & (v >= 0) & (v <= ny - 1)
    u, v = np.clip(u, 0, nx - 1), np.clip(v, 0, ny - 1)
    i, j = np.minimum(u.astype(np.int32), nx - 2), np.minimum(v.astype(np.int32), ny - 2)
    fu, fv = u - i.astype(u.dtype), v - j.astype(v.dtype)
    place, flat = j * nx + i, record.reshape(-1, 4)
    shares = ((1 - fu) * (1 - fv), fu * (1 - fv), (1 - fu) * fv, fu * fv)
    x, y, z, variance = found = np.zeros((4, len(u)), dtype=record.dtype)
    for offset, share in zip((0, 1, nx, nx + 1), shares, strict=True):
        corner = np.ascontiguousarray(flat.take(place + offset, axis=0).T)
        corner *= share
        found += corner
    mapped = inside & (variance < UNMAPPED_UT2)
    x -= moved[2] * bx - moved[3] * by
    y -= moved[3] * bx + moved[2] * by
    z -= bz
    variance += sensor
    return -0.5 * ((x * x + y * y + z * z) / variance + 3.0 * np.log(variance)), mapped


def _weighed(weight: Float32, fit: Float32, mapped: NDArray[np.bool_]) -> Float32:
    told = mapped & (weight > 0)
    if not told.any():
        return weight.copy()
    likely = np.exp(np.minimum(fit - fit.max(where=told, initial=-np.inf), 0.0))
    if told.all():
        return np.asarray(weight * likely)
    mean = float(np.sum((weight * likely)[told], dtype=np.float64) / np.sum(weight[told], dtype=np.float64))
    return np.asarray(weight * np.where(mapped, likely, weight.dtype.type(mean)))


def _weighted_sums(moved: Float32, weight: Float32) -> Array:
    x, y = moved[0] - moved[0, 0], moved[1] - moved[1, 0]
    wx, wy = weight * x, weight * y
    rows = [weight.sum(), wx.sum(), wy.sum(), *(moved[2:] @ weight), wx @ x, wx @ y, wy @ y, weight @ weight]
    return np.array([*rows, moved[0, 0], moved[1, 0]], dtype=np.float64)
