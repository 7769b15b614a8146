"""Regions out of date: where recent surveys contradict older ones that agree among themselves.

Metal is moved, a lift is put in: the field of a region changes for good, and every survey walked since says so. Over
blocks of three metres each survey's errors against the map of the others are averaged, without what it is off by
everywhere (its median block) and in units of how badly it fits everywhere (the robust scale of its blocks): a bad
survey is inconsistent (Kuevor B14), it does not make the building drift. Then, per block and component, every split of
the surveys in order of time is tried. Evidence is the difference of the two sides' weighted means in its sd, which is
widened by how far surveys of the same side disagree; the older side has at least two surveys. A map is said to be out
of date where evidence holds after Bonferroni over all blocks, components and splits; such a block takes its neighbours
along that show the same less clearly.

Both sides are in the map the others are judged by, so errors of n surveys differ by n / (n - 1) of the change.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.special import log_ndtr

from app.field.leave_one_out import HeldOut
from app.field.observations import STRETCH_M, Walk
from app.field.spec import OutOfDateRegion
from app.field.tally import means_of_places
from app.geometry import Array

__all__ = ["BLOCK_M", "FAMILY_CHANCE", "out_of_date_regions"]

BLOCK_M = 3.0
STEP_M = 1.5
LEAST_VARIANCE_UT2 = 1e-6
"""Blocks overlap by half, or a magnet in the middle of one, whose field points both ways, would go unseen."""
OVERLAP = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
FAMILY_CHANCE = 0.01
"""At most about this share of unchanged maps has a region reported."""
NEIGHBOUR_CHANCE = 0.01
FEWEST_OLDER = 2
FEWEST_STRETCHES = 5
"""A survey has a say on a block it walked at least a metre of."""
FEWEST_BLOCKS = 12
LEAST_CHANGE_SD = 1.0
"""Of one measurement: a smaller change does not matter to anybody who measures."""
GENEROSITY = 1.5
"""Blocks' errors have heavier tails than their median tells: sds are this many times what the usual survey shows."""
OFF_EVERYWHERE = 2.0
"""A survey that fits this many times worse than the usual one has no say: it is inconsistent."""
ROBUST_SD = 1.4826
"""Sd of a Gaussian over the median of its absolute values."""


class _Table(NamedTuple):
    """What surveys say of blocks: row after row by block, in each in order of time."""

    block: NDArray[np.int64]  # (r, 2) row and column of the block on the plan
    rank: NDArray[np.int64]  # (r,) place of the survey in time
    error_uT: Array  # (r, c) without what the survey is off by everywhere
    sd_uT: Array  # (r, c) of that mean
    single_sd_uT: Array  # (r, c) of one measurement

    def at(self, rows: slice | NDArray[Any]) -> "_Table":
        return _Table(self.block[rows], self.rank[rows], self.error_uT[rows], self.sd_uT[rows], self.single_sd_uT[rows])


class _Verdicts(NamedTuple):
    """The clearest split of every block; of one, (c,) and a number."""

    log_p: Array  # (b, c) by chance in this block, all splits and components counted; 0 where there is none
    change_uT: Array  # (b, c)
    first_recent: NDArray[np.int64]  # (b,) rank

    def at(self, block: np.intp) -> "_Verdicts":
        return _Verdicts(*(each[block] for each in self))


def out_of_date_regions(
    walks: Sequence[Walk],
    held_out: Mapping[str, HeldOut],
    order: Sequence[str],
    names: tuple[str, ...],
    correlation_m: float,
) -> tuple[OutOfDateRegion, ...]:
    """Regions where the map is out of date, clearest first.

    order: survey ids, oldest first. names: of the components. correlation_m: distance over which errors stay
    correlated. A survey whose judged ground is under FEWEST_BLOCKS blocks has no say: it cannot be told from an offset.
    """
    table = _table(walks, held_out, order, correlation_m)
    if table is None:
        return ()
    blocks, first = _runs(table.block)
    bounds = np.append(first, len(table.rank))
    verdicts = _judge(table, bounds)
    tested = int(np.count_nonzero(np.diff(bounds) > FEWEST_OLDER))
    if not tested:
        return ()
    low = blocks.min(axis=0)
    clearest = verdicts.log_p.min(axis=1)
    log_p = np.zeros(blocks.max(axis=0) - low + 1)
    log_p[tuple((blocks - low).T)] = clearest
    regions, count = label(log_p <= np.log(NEIGHBOUR_CHANCE), structure=np.ones((3, 3)))
    found = []
    region_of_block = regions[tuple((blocks - low).T)]
    for region in range(1, count + 1):
        inside = np.flatnonzero(region_of_block == region)
        best = verdicts.at(inside[np.argmin(clearest[inside])])
        best = best._replace(log_p=best.log_p + np.log(tested))
        if best.log_p.min() <= np.log(FAMILY_CHANCE):
            here = np.concatenate([table.rank[bounds[block] : bounds[block + 1]] for block in inside])
            found.append(_region(blocks[inside], best, np.unique(here), order, names))
    return tuple(sorted(found, key=lambda region: region.p_value))


def _runs(block: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
    """The different ones of ordered blocks (r, 2), and where each begins."""
    first = np.append(0, np.flatnonzero(np.any(block[1:] != block[:-1], axis=1)) + 1)
    return block[first], first


def _region(
    blocks: NDArray[np.int64], best: _Verdicts, ranks: NDArray[np.int64], order: Sequence[str], names: tuple[str, ...]
) -> OutOfDateRegion:
    (y0, x0), (y1, x1) = blocks.min(axis=0) * STEP_M, blocks.max(axis=0) * STEP_M + BLOCK_M
    return OutOfDateRegion(
        bounds_m=(float(x0), float(y0), float(x1), float(y1)),
        components=tuple(n for n, log_p in zip(names, best.log_p, strict=True) if log_p <= np.log(FAMILY_CHANCE)),
        change_ut=tuple(best.change_uT.tolist()),
        surveys_before=tuple(order[rank] for rank in ranks if rank < best.first_recent),
        surveys_after=tuple(order[rank] for rank in ranks if rank >= best.first_recent),
        p_value=float(np.exp(best.log_p.min())),
    )


def _judge(table: _Table, bounds: NDArray[np.int64]) -> _Verdicts:
    """Every split of each block's surveys into older and recent; blocks of as many surveys are judged together."""
    count = np.diff(bounds)
    log_p, change_uT = np.zeros((2, len(count), table.error_uT.shape[1]))
    first_recent = np.zeros(len(count), dtype=np.int64)
    for n in np.unique(count[count > FEWEST_OLDER]).tolist():
        here = np.flatnonzero(count == n)
        rows = bounds[here, None] + np.arange(n)
        log_p[here], change_uT[here], split = _clearest(*(each[rows] for each in table[2:]))
        first_recent[here] = table.rank[bounds[here] + FEWEST_OLDER + split]
    return _Verdicts(log_p, change_uT, first_recent)


def _clearest(error_uT: Array, sd_uT: Array, single_sd_uT: Array) -> tuple[Array, Array, NDArray[np.int64]]:
    """Of blocks (b, n, c) of n surveys in order of time: log p and change (b, c) of the clearest split, and which."""
    n = error_uT.shape[1]
    weight = 1.0 / np.maximum(np.square(sd_uT), LEAST_VARIANCE_UT2)
    moments = np.cumsum(np.stack([weight, weight * error_uT, weight * error_uT**2]), axis=2)
    older = moments[:, :, FEWEST_OLDER - 1 : -1]  # (3, b, splits, c)
    recent = moments[:, :, -1:] - older
    change_uT = recent[1] / recent[0] - older[1] / older[0]
    scatter = (older[2] - older[1] ** 2 / older[0] + recent[2] - recent[1] ** 2 / recent[0]) / (n - 2)
    split_sd_uT = np.sqrt(np.maximum(scatter, 1.0) * (1.0 / older[0] + 1.0 / recent[0]))
    change_uT *= (n - 1) / n
    log_p = log_ndtr(-np.abs(change_uT) / split_sd_uT) + np.log(2.0 * change_uT[0].size)
    matters = np.abs(change_uT) >= LEAST_CHANGE_SD * np.median(single_sd_uT, axis=1, keepdims=True)
    log_p = np.where(matters, np.minimum(log_p, 0.0), 0.0)
    split = np.argmin(log_p.min(axis=2), axis=1)
    chosen = np.arange(len(split)), split
    return log_p[chosen], change_uT[chosen], split


def _table(
    walks: Sequence[Walk], held_out: Mapping[str, HeldOut], order: Sequence[str], correlation_m: float
) -> _Table | None:
    """What every survey says, or None when none has a say."""
    by_name = {walk.survey_id: walk for walk in walks}
    said = [
        rows
        for rank, name in enumerate(order)
        if name in by_name and (rows := _say(by_name[name], held_out[name], rank, correlation_m)) is not None
    ]
    if not said:
        return None
    misfits = np.array([ROBUST_SD * np.median(np.abs(rows.error_uT / rows.sd_uT), axis=0) for rows in said])
    usual = np.median(misfits, axis=0)
    said = [
        rows._replace(sd_uT=rows.sd_uT * np.maximum(misfit, GENEROSITY * usual))
        for rows, misfit in zip(said, misfits, strict=True)
        if np.all(misfit <= OFF_EVERYWHERE * np.maximum(usual, 0.5))
    ]
    table = _Table(*(np.concatenate(each) for each in zip(*said, strict=True)))
    return table.at(np.lexsort((table.rank, table.block[:, 1], table.block[:, 0])))


def _say(walk: Walk, held_out: HeldOut, rank: int, correlation_m: float) -> _Table | None:
    """What one survey says of the blocks it walked, its offset taken out; None when they are too few."""
    errors_uT, judged = means_of_places(held_out.error_uT, walk.stretch_of_sample, held_out.judged, len(walk))
    variances_uT2, _ = means_of_places(np.square(held_out.sd_uT), walk.stretch_of_sample, held_out.judged, len(walk))
    stretches = np.flatnonzero(judged)
    if not len(stretches):
        return None
    corner = np.floor(walk.position_m[stretches, 1::-1].T / STEP_M).astype(np.int64)  # (2, n): rows are quick
    row, column = (corner[:, :, None] - OVERLAP.T[:, None]).reshape(2, -1)
    key = row * (np.ptp(column) + 1) + column
    order = np.argsort(key, kind="stable")
    first = np.append(0, np.flatnonzero(np.diff(key[order])) + 1)
    count = np.diff(np.append(first, len(key)))
    heard = count >= FEWEST_STRETCHES
    if np.count_nonzero(heard) < FEWEST_BLOCKS:
        return None
    block = np.stack([row, column], axis=1)[order[first[heard]]]
    among = np.hstack([errors_uT, variances_uT2]).take(stretches[order // len(OVERLAP)], axis=0)
    error_uT, variance_uT2 = np.hsplit((np.add.reduceat(among, first) / count[:, None])[heard], 2)
    single_sd_uT = np.sqrt(variance_uT2)
    independent = np.maximum(1.0, STRETCH_M * count[heard] / max(2.0 * correlation_m, STRETCH_M))
    offset_uT = np.median(error_uT, axis=0)
    ranks = np.full(len(error_uT), rank)
    return _Table(block, ranks, error_uT - offset_uT, single_sd_uT / np.sqrt(independent)[:, None], single_sd_uT)
