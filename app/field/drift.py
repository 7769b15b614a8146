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
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.special import log_ndtr

from app.field.leave_one_out import HeldOut
from app.field.observations import STRETCH_M, Walk
from app.field.spec import OutOfDateRegion
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


class _Verdict(NamedTuple):
    """The clearest split of one block."""

    log_p: Array  # (c,) by chance in this block, all splits and components counted
    change_uT: Array  # (c,)
    first_recent: int  # rank


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
    blocks, first = np.unique(table.block, axis=0, return_index=True)
    bounds = np.append(first, len(table.rank))
    verdicts = [_judge(table.at(slice(a, b))) for a, b in pairwise(bounds.tolist())]
    tested = sum(verdict is not None for verdict in verdicts)
    if not tested:
        return ()
    low = blocks.min(axis=0)
    log_p = np.zeros(blocks.max(axis=0) - low + 1)
    for (row, column), verdict in zip(blocks - low, verdicts, strict=True):
        log_p[row, column] = 0.0 if verdict is None else verdict.log_p.min()
    regions, count = label(log_p <= np.log(NEIGHBOUR_CHANCE), structure=np.ones((3, 3)))
    found = []
    region_of_block = regions[tuple((blocks - low).T)]
    for region in range(1, count + 1):
        inside = np.flatnonzero(region_of_block == region)
        best = min((v for k in inside if (v := verdicts[k])), key=lambda verdict: float(verdict.log_p.min()))
        best = best._replace(log_p=best.log_p + np.log(tested))
        if best.log_p.min() <= np.log(FAMILY_CHANCE):
            here = table.rank[np.isin(np.searchsorted(bounds, np.arange(len(table.rank)), side="right") - 1, inside)]
            found.append(_region(blocks[inside], best, np.unique(here), order, names))
    return tuple(sorted(found, key=lambda region: region.p_value))


def _region(
    blocks: NDArray[np.int64], best: _Verdict, ranks: NDArray[np.int64], order: Sequence[str], names: tuple[str, ...]
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


def _judge(rows: _Table) -> _Verdict | None:
    """Every split of one block's surveys into older and recent; None when there are too few to split."""
    n = len(rows.rank)
    if n <= FEWEST_OLDER:
        return None
    weight = 1.0 / np.maximum(np.square(rows.sd_uT), LEAST_VARIANCE_UT2)
    moments = np.cumsum(np.stack([weight, weight * rows.error_uT, weight * rows.error_uT**2]), axis=1)
    older = moments[:, FEWEST_OLDER - 1 : -1]  # (3, splits, c)
    recent = moments[:, -1:] - older
    change_uT = recent[1] / recent[0] - older[1] / older[0]
    scatter = (older[2] - older[1] ** 2 / older[0] + recent[2] - recent[1] ** 2 / recent[0]) / (n - 2)
    sd_uT = np.sqrt(np.maximum(scatter, 1.0) * (1.0 / older[0] + 1.0 / recent[0]))
    change_uT *= (n - 1) / n
    log_p = log_ndtr(-np.abs(change_uT) / sd_uT) + np.log(2.0 * change_uT.size)
    matters = np.abs(change_uT) >= LEAST_CHANGE_SD * np.median(rows.single_sd_uT, axis=0)
    log_p = np.where(matters, np.minimum(log_p, 0.0), 0.0)
    best = int(np.argmin(log_p.min(axis=1)))
    return _Verdict(log_p[best], change_uT[best], int(rows.rank[FEWEST_OLDER + best]))


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
    judged = np.flatnonzero(held_out.judged)
    stretches, place = np.unique(walk.stretch_of_sample[judged], return_inverse=True)
    if not len(stretches):
        return None
    error_uT = np.repeat(_means(place, held_out.error_uT[judged]), len(OVERLAP), axis=0)
    variance_uT2 = np.repeat(_means(place, np.square(held_out.sd_uT[judged])), len(OVERLAP), axis=0)
    corner = np.floor(walk.position_m[stretches, 1::-1] / STEP_M).astype(np.int64)
    cell = (corner[:, None] - OVERLAP).reshape(-1, 2)
    low, wide = cell.min(axis=0), int(np.ptp(cell[:, 1])) + 1
    key, place, count = np.unique((cell - low) @ [wide, 1], return_inverse=True, return_counts=True)
    block = low + np.stack(np.divmod(key, wide), axis=1)
    heard = count >= FEWEST_STRETCHES
    if np.count_nonzero(heard) < FEWEST_BLOCKS:
        return None
    error_uT, single_sd_uT = _means(place, error_uT)[heard], np.sqrt(_means(place, variance_uT2))[heard]
    independent = np.maximum(1.0, STRETCH_M * count[heard] / max(2.0 * correlation_m, STRETCH_M))
    offset_uT = np.median(error_uT, axis=0)
    ranks = np.full(len(error_uT), rank)
    return _Table(block[heard], ranks, error_uT - offset_uT, single_sd_uT / np.sqrt(independent)[:, None], single_sd_uT)


def _means(place: NDArray[np.intp], values: Array) -> Array:
    """Mean of values (n, c) over each group: (groups, c)."""
    sums = np.stack([np.bincount(place, column) for column in values.T], axis=1)
    return np.asarray(sums / np.bincount(place)[:, None])
