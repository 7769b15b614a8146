"""Records of an Android trace of the Indoor Location Competition 2.0: `unix_ms TYPE_... values`, tab-separated.

Only motion, magnetic and waypoint records are read; radio records (TYPE_WIFI, TYPE_BEACON ...) are passed over. The
recorder sometimes glued two records on one line; both are read.
"""

import re
from collections import defaultdict
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from app.errors import Fault, UnreadableSurvey
from app.geometry import Array
from app.survey.columns import MAX_FAULTS, MAX_SAMPLES, check_sample_count

__all__ = ["Stream", "Trace", "parse_trace"]

VALUES_OF = {
    "ACCELEROMETER": 3,
    "GYROSCOPE": 3,
    "MAGNETIC_FIELD": 3,
    "MAGNETIC_FIELD_UNCALIBRATED": 6,
    "ROTATION_VECTOR": 3,
    "WAYPOINT": 2,
}
"""How many leading numbers of each kind of record are used; what follows (accuracy) may be missing."""
LARGEST_VALUE = 1e6

_RECORD = re.compile(r"\d{10,16}\tTYPE_[A-Z_0-9]+")
_GLUED = re.compile(r"(?<=.)\d{13}\tTYPE_[A-Z_]+")
_WITH_NAMES = ("TYPE_WIFI", "TYPE_BEACON")
_HEADER_KEYS = {"Brand", "Model", "AndroidName", "SiteID", "SiteName", "FloorId", "FloorName"}


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """One sensor: t_s (n,) strictly increasing seconds of the Unix clock, values (n, k)."""

    t_s: Array
    values: Array

    def __len__(self) -> int:
        return len(self.t_s)

    def at(self, t_s: Array) -> Array:
        """Values interpolated linearly, held beyond the ends."""
        return np.stack([np.interp(t_s, self.t_s, column) for column in self.values.T], axis=1)


@dataclass(frozen=True, slots=True)
class Trace:
    """What a trace holds: streams by kind ("GYROSCOPE"), header entries, and what had to be passed over."""

    streams: dict[str, Stream]
    header: dict[str, str]
    warnings: list[str]


@dataclass(slots=True)
class _Records:
    """Records as they are collected: (line number, unix ms, values) by kind."""

    kept: defaultdict[str, list[tuple[int, int, list[float]]]] = field(default_factory=lambda: defaultdict(list))
    columns: dict[str, int] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)
    glued: int = 0
    dropped: int = 0
    count: int = 0


def parse_trace(data: bytes) -> Trace:
    """Streams of a trace. Raises UnreadableSurvey with line and reason, TooLarge."""
    if not data.strip():
        raise UnreadableSurvey("the file is empty", Fault("file", "0 bytes of text"))
    if b"\tTYPE_" not in data:
        raise UnreadableSurvey(
            "this is no trace of the Indoor Location Competition 2.0: no line reads 'unix_ms<tab>TYPE_...'; "
            "name the format the file really has",
            Fault("file", "no TYPE_ record"),
        )
    lines = data.decode("utf-8", errors="replace").split("\n")
    records, header = _Records(), dict[str, str]()
    previous = ""
    cut = _last_line_is_cut(lines)
    if cut:
        lines = lines[:-1]
    for number, line in enumerate(lines, start=1):
        line = line.rstrip("\r")
        if line.startswith("#"):
            header.update(_header_entries(line))
        elif line.strip():
            previous = _read_line(records, number, line, previous)
        if len(records.faults) >= MAX_FAULTS:
            break
    if records.faults:
        first = records.faults[0]
        raise UnreadableSurvey(
            f"the trace is damaged at {first.location}: {first.reason}", *records.faults[:MAX_FAULTS]
        )
    warnings = ["the last line was cut and was dropped: the recording may be incomplete"] if cut else []
    if records.glued:
        warnings.append(f"{records.glued} lines held two records; {records.dropped} incomplete ones were dropped")
    streams = {kind: _stream(kind, rows, warnings) for kind, rows in records.kept.items()}
    return Trace(streams, header, warnings)


def _header_entries(line: str) -> dict[str, str]:
    """`key:value` entries of a `#` line that describe the recording."""
    pairs = (part.strip("# \t\r").partition(":") for part in line.split("\t"))
    return {key: value[:80] for key, _, value in pairs if key in _HEADER_KEYS}


def _last_line_is_cut(lines: list[str]) -> bool:
    """Whether the file ends in the middle of a line: no line feed, and the last record short of its kind."""
    last = lines[-1]
    if not last.strip() or last.startswith("#"):
        return False
    parts = last.rstrip("\r").split("\t")
    if len(parts) < 2 or not _RECORD.match(last):
        return True
    alike = next((line for line in reversed(lines[:-1]) if f"\t{parts[1]}\t" in line), None)
    needed = 2 + VALUES_OF.get(parts[1].removeprefix("TYPE_"), 0)
    return len(parts) < (len(alike.rstrip("\r").split("\t")) if alike else needed)


def _read_line(records: _Records, number: int, line: str, previous: str) -> str:
    """Read the records on a line; returns the kind of the last one."""
    if not _RECORD.match(line):
        if not previous.startswith(_WITH_NAMES):  # a network's name may hold a line feed
            records.faults.append(Fault(f"line {number}", f"{line[:40]!r} is no record 'unix_ms<tab>TYPE_...'"))
        return previous
    starts = [0, *(match.start() for match in _GLUED.finditer(line) if match.start() > 13), len(line)]
    records.glued += len(starts) > 2
    kind = previous
    for start, stop in pairwise(starts):
        parts = line[start:stop].split("\t")
        kind = parts[1]
        _keep(records, number, parts, glued=len(starts) > 2)
    return kind


def _keep(records: _Records, number: int, parts: list[str], *, glued: bool) -> None:
    kind = parts[1].removeprefix("TYPE_")
    wanted = VALUES_OF.get(kind)
    if wanted is None:
        return
    records.count += 1
    if records.count > 8 * MAX_SAMPLES:
        check_sample_count(records.count)
    cells = parts[2 : 2 + wanted]
    values = [_number(cell) for cell in cells]
    wrong = next((k for k, x in enumerate(values) if not abs(x) <= LARGEST_VALUE), None)
    if len(cells) == wanted and wrong is None:
        records.kept[kind].append((number, int(parts[0]), values))
    elif glued:
        records.dropped += 1
    elif wrong is not None:
        reason = f"{cells[wrong][:40]!r} is not a finite number of a {parts[1]}"
        records.faults.append(Fault(f"line {number}, column {wrong + 3}", reason))
    else:
        records.faults.append(Fault(f"line {number}", f"{parts[1]} has {len(cells)} values, needs {wanted}"))


def _number(cell: str) -> float:
    """The number in a cell, NaN when it is none."""
    try:
        return float(cell) if "_" not in cell else np.nan
    except ValueError:
        return np.nan


def _stream(kind: str, rows: list[tuple[int, int, list[float]]], warnings: list[str]) -> Stream:
    """Rows as arrays with repeated times dropped. Raises UnreadableSurvey where time goes backwards."""
    t_ms = np.array([row[1] for row in rows], dtype=np.int64)
    step_ms = np.diff(t_ms)
    back = np.flatnonzero(step_ms < 0)
    if len(back):
        faults = [
            Fault(f"line {rows[i + 1][0]}", f"time of TYPE_{kind} goes back by {-step_ms[i]} ms")
            for i in back[:MAX_FAULTS]
        ]
        raise UnreadableSurvey(f"time goes backwards at {faults[0].location}: {faults[0].reason}", *faults)
    kept = np.concatenate([[True], step_ms > 0])
    if not kept.all():
        warnings.append(f"{int(np.sum(~kept))} TYPE_{kind} records repeated a time and were dropped")
    values = np.array([row[2] for row in rows], dtype=np.float64)
    return Stream(t_ms[kept] / 1e3, values[kept])
