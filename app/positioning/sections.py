"""Matching against a map that is a list of samples along roads or corridors (Shockley 6-8).

A section is n consecutive samples at one spacing, compared with every n-long run of the map: raw, demeaned,
differenced, or differenced and whitened, which is demeaned again (Shockley 8.6). An anomaly is a stretch of any length
about a peak, compared peak on peak (Shockley 8.7). Field values are (..., c) columns of any components, uT; with noise
that differs between the columns, divide by it first.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.distance import cdist

from app.geometry import Array

__all__ = [
    "Anomaly", "AnomalyMatch", "Resampled", "Transform", "compared_length", "contiguous_stretches", "detect_anomalies",
    "match_anomaly", "peak_of", "resample_by_distance", "section_features", "section_starts", "section_transform",
    "sections_at", "sum_of_squares", "travelled_m",
]  # fmt: skip

Transform = Literal["raw", "demeaned", "differenced", "whitened"]
Indices = NDArray[np.int64]


class Resampled(NamedTuple):
    """Places `distance_m` (k,) along the path, equally spaced but for gaps, and the columns (k, d) there."""

    distance_m: Array
    columns: Array


class Anomaly(NamedTuple):
    """Samples `first` to `stop` (excluded) of a map, the defining `peak` among them, as indices into the map."""

    first: int
    stop: int
    peak: int


class AnomalyMatch(NamedTuple):
    """The anomaly that fits best: its index, root sum of squares and root mean square, uT, over `samples` aligned."""

    anomaly: int
    rss_uT: float
    rms_uT: float
    samples: int


# ---- the map as a list of samples


def contiguous_stretches(along: Array, longest_gap: float, road: Indices | None = None) -> Indices:
    """The number (m,) of the stretch that each sample is of; a new one after a gap, backwards, or on another road.

    `along` (m,) is metres travelled or seconds, `longest_gap` in the same unit; `road` (m,) any labels.
    """
    step = np.diff(along)
    broken = (step > longest_gap) | (step < 0.0)
    if road is not None:
        broken |= np.diff(road) != 0
    return np.concatenate([[0], np.cumsum(broken)])[: len(along)].astype(np.int64)


def section_starts(stretch: Indices, samples: int) -> Indices:
    """The first index of every run of `samples` samples that lies within one stretch, in map order."""
    last = np.arange(samples - 1, len(stretch), dtype=np.int64)
    first = last - (samples - 1)
    return np.asarray(first[stretch[first] == stretch[last]])


def travelled_m(t_s: Array, position_m: Array, slowest_m_s: float = 0.0) -> tuple[Array, NDArray[np.bool_]]:
    """Metres travelled (n,) over positions (n, >= 2), and which samples were taken in motion (Shockley 6.2, L1051).

    A step slower than `slowest_m_s` is standing still: it adds no distance, and the sample it leads to is not in
    motion. Times must increase.
    """
    step_m = np.linalg.norm(np.diff(position_m[:, :2], axis=0), axis=1)
    moves = step_m >= slowest_m_s * np.diff(t_s)
    walked = np.concatenate([[0.0], np.cumsum(np.where(moves, step_m, 0.0))])
    return walked, np.concatenate([moves[:1], moves]) if len(moves) else np.ones(len(t_s), dtype=bool)


def resample_by_distance(
    distance_m: Array,
    columns: Array,
    spacing_m: float,
    *,
    moving: NDArray[np.bool_] | None = None,
    longest_gap_m: float,
) -> Resampled:
    """Columns (n, d) at every multiple of `spacing_m` along the path: the mean of the samples within half a spacing.

    Where there are none, linear between the neighbours, unless those are more than `longest_gap_m` apart: such places
    are left out. `distance_m` (n,) must not decrease; samples not `moving` are dropped (Shockley 6.2, L1051).
    """
    if moving is not None:
        distance_m, columns = distance_m[moving], columns[moving]
    if not len(distance_m):
        return Resampled(distance_m, columns)
    first, last = np.ceil(distance_m[0] / spacing_m - 1e-9), np.floor(distance_m[-1] / spacing_m + 1e-9)
    at = np.arange(first, last + 1.0) * spacing_m
    low = np.searchsorted(distance_m, at - 0.5 * spacing_m, side="left")
    high = np.searchsorted(distance_m, at + 0.5 * spacing_m, side="right")
    sums = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns - columns[0], axis=0)])
    between = np.stack([np.interp(at, distance_m, column) for column in columns.T], axis=1)
    mean = (sums[high] - sums[low]) / np.maximum(high - low, 1)[:, None] + columns[0]
    before = np.clip(np.searchsorted(distance_m, at, side="right") - 1, 0, len(distance_m) - 1)
    gap_m = distance_m[np.minimum(before + 1, len(distance_m) - 1)] - distance_m[before]
    kept = (high > low) | (gap_m <= longest_gap_m)
    return Resampled(at[kept], np.where((high > low)[:, None], mean, between)[kept])


# ---- sections


def section_transform(transform: Transform, samples: int) -> Array:
    """The matrix (k, samples) that a section is multiplied by before it is compared (Shockley 8.6, L1236).

    Raw: I. Demeaned: I - 11'/n. Differenced: D, first differences. Whitened: (D D')^-1/2 D, whose sum of squares is
    that of the demeaned section, since D' (D D')^-1 D projects on what has no mean. All but raw need two samples.
    """
    if transform == "raw":
        return np.eye(samples)
    assert samples >= 2, samples
    if transform == "demeaned":
        return np.eye(samples) - 1.0 / samples
    difference = np.diff(np.eye(samples), axis=0)
    if transform == "differenced":
        return difference
    eigenvalue, vector = np.linalg.eigh(difference @ difference.T)
    return np.asarray((vector / np.sqrt(eigenvalue)) @ vector.T @ difference)


def compared_length(transform: Transform, samples: int, components: int) -> int:
    """The independent scalars in a compared section, for a chi-square gate."""
    return components * (samples if transform == "raw" else samples - 1)


def sections_at(field_uT: Array, starts: Indices, samples: int) -> Array:
    """The runs (s, samples, c) of a list of field values (m, c) that begin at `starts` (s,)."""
    return np.asarray(field_uT[starts[:, None] + np.arange(samples)])


def section_features(sections_uT: Array, transform: Transform) -> Array:
    """Sections (s, n, c) as the vectors (s, k c) that are compared."""
    matrix = section_transform(transform, sections_uT.shape[1])
    return np.ascontiguousarray(np.einsum("kn,snc->skc", matrix, sections_uT).reshape(len(sections_uT), -1))


def sum_of_squares(queries_uT: Array, field_uT: Array, starts: Indices, transform: Transform = "raw") -> Array:
    """Sums of squared differences (q, s) of queries (q, n, c) to the map's runs at `starts` (s,), uT^2 (Shockley 8.6).

    A single epoch is a section of one sample. The log-likelihood of equal noise is -SS / (2 sigma^2) (Shockley 7.1).
    """
    runs = sections_at(field_uT, starts, queries_uT.shape[1])
    return np.asarray(cdist(section_features(queries_uT, transform), section_features(runs, transform), "sqeuclidean"))


# ---- anomalies


def peak_of(section_uT: Array) -> int:
    """The sample of a section (n, c) that lies farthest from the section's median (Shockley 8.7)."""
    return int(np.argmax(np.linalg.norm(section_uT - np.median(section_uT, axis=0), axis=1)))


def detect_anomalies(
    field_uT: Array, stretch: Indices, *, background: int, threshold_uT: float, margin: int, shortest: int = 2
) -> list[Anomaly]:
    """Stretches of a map (m, c) that leave the slowly varying field, a running median of `background` samples.

    The rule is ours; the source picked anomalies by eye (Shockley 8.7, L1247). Samples more than `threshold_uT` from
    the background are widened by `margin` samples on both sides; what then overlaps is one anomaly. Those with fewer
    than `shortest` samples are dropped.
    """
    found: list[Anomaly] = []
    for number in range(int(stretch[-1]) + 1 if len(stretch) else 0):
        first, stop = np.searchsorted(stretch, [number, number + 1])
        part = field_uT[first:stop]
        slow = median_filter(part, size=(min(background, len(part)), 1), mode="reflect")
        out = np.linalg.norm(part - slow, axis=1) > threshold_uT
        wide = np.convolve(out, np.ones(2 * margin + 1), mode="full")[margin : margin + len(part)] > 0.5
        edges = np.flatnonzero(np.diff(np.concatenate([[False], wide, [False]])))
        for a, b in edges.reshape(-1, 2):
            if b - a >= shortest:
                found.append(Anomaly(int(first + a), int(first + b), int(first + a) + peak_of(part[a:b])))
    return found


def match_anomaly(
    query_uT: Array,
    field_uT: Array,
    anomalies: Sequence[Anomaly],
    *,
    transform: Transform = "raw",
    threshold_rms_uT: float = np.inf,
    by: Literal["rms", "rss"] = "rms",
) -> AnomalyMatch | None:
    """The map's anomaly most like a query section (n, c), peak on peak, both cut to what they share (Shockley, L1253).

    The source compares root sums of squares, which favour what shares little; `by` says which of the two decides. None
    when the best is above the threshold (Shockley, L1255), or when no two samples can be compared.
    """
    peak, best = peak_of(query_uT), None
    for index, anomaly in enumerate(anomalies):
        before = min(peak, anomaly.peak - anomaly.first)
        after = min(len(query_uT) - peak, anomaly.stop - anomaly.peak)
        if before + after < 2:
            continue
        difference = query_uT[peak - before : peak + after] - field_uT[anomaly.peak - before : anomaly.peak + after]
        rss = float(np.linalg.norm(section_transform(transform, before + after) @ difference))
        rms = rss / np.sqrt(compared_length(transform, before + after, query_uT.shape[1]))
        match = AnomalyMatch(index, rss, rms, before + after)
        if best is None or (rms < best.rms_uT if by == "rms" else rss < best.rss_uT):
            best = match
    return best if best is not None and best.rms_uT <= threshold_rms_uT else None
