"""What it costs to read surveys in processes of their own: the time against reading them here, and the memory.

`python benchmarks/parse_process.py` prints a ratio per kind and size of file; the largest are the largest uploads.
"""

import argparse
import io
import os
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from threading import Event, Thread

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from app.services.file_orders import SurveyOrder, read_on_floor
from app.services.file_readers import FileReaders

LIMIT_BYTES = 64 * 2**20
NAMES = ("t_s", "x_m", "y_m", "z_m", "bx_ut", "by_ut", "bz_ut")


def table(rows: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    t = 0.01 * np.arange(rows)
    walk = [20 * np.sin(t / 10), 20 * np.cos(t / 10), np.full(rows, 1.2)]
    return np.column_stack([t, *walk, rng.normal([20.0, 0.0, -43.0], 1.0, (rows, 3))])


def as_csv(rows: int) -> bytes:
    out = io.StringIO()
    np.savetxt(out, table(rows), fmt="%.2f", delimiter=",", header=",".join(NAMES), comments="")
    return out.getvalue().encode()


def as_ndjson(rows: int) -> bytes:
    line = "{" + ",".join(f'"{name}":%.2f' for name in NAMES) + "}"
    out = io.StringIO()
    np.savetxt(out, table(rows), fmt=line)
    return out.getvalue().encode()


def as_parquet(rows: int) -> bytes:
    out = io.BytesIO()
    parquet.write_table(pa.table(dict(zip(NAMES, table(rows).T, strict=True))), out)
    return out.getvalue()


def as_trace(rows: int) -> bytes:
    """A phone that is turned in the hand, five sensors a row."""
    rng = np.random.default_rng(0)
    lines = []
    for k, t in enumerate(1_574_129_692_000 + 20 * np.arange(rows)):
        if k in (0, rows - 1):
            lines.append(f"{t}\tTYPE_WAYPOINT\t{k / rows}\t0.0")
        noise = rng.normal(0, 0.1, 12)
        force = 9.81 + np.sin(2 * np.pi * k / 25)
        lines += [
            f"{t}\tTYPE_ACCELEROMETER\t{noise[0]:.4f}\t{noise[1]:.4f}\t{force:.4f}\t3",
            f"{t}\tTYPE_MAGNETIC_FIELD\t{20 + noise[3]:.4f}\t{noise[4]:.4f}\t{noise[5] - 43:.4f}\t3",
            f"{t}\tTYPE_GYROSCOPE\t{noise[6]:.4f}\t{noise[7]:.4f}\t{noise[8]:.4f}\t3",
            f"{t}\tTYPE_ROTATION_VECTOR\t{noise[9]:.4f}\t{noise[10]:.4f}\t{noise[11]:.4f}\t3",
            f"{t}\tTYPE_MAGNETIC_FIELD_UNCALIBRATED\t20.{k % 9}\t{noise[4]:.4f}\t{noise[5] - 43:.4f}\t0\t0\t0\t3",
        ]
    return ("\n".join(lines) + "\n").encode()


MAKERS: dict[str, Callable[[int], bytes]] = {
    "csv": as_csv, "ndjson": as_ndjson, "parquet": as_parquet, "indoor-location-2020": as_trace,
}  # fmt: skip


def at_the_limit(make: Callable[[int], bytes]) -> bytes:
    sample = make(2000)
    rows = min(int(LIMIT_BYTES / len(sample) * 2000), 1_990_000)
    data = make(rows)
    return data if len(data) <= LIMIT_BYTES else make(int(rows * LIMIT_BYTES / len(data) * 0.99))


class Peak:
    """The most address space that a child of `program` took beyond the program's own."""

    def __init__(self, program: int) -> None:
        self._program, self._end, self.bytes = program, Event(), 0
        self._thread = Thread(target=self._watch, daemon=True)

    def __enter__(self) -> "Peak":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _watch(self) -> None:
        own = self._peak(self._program)
        while not self._end.wait(0.02):
            for child in Path(f"/proc/{self._program}/task/{self._program}/children").read_text().split():
                self.bytes = max(self.bytes, self._peak(int(child)) - own)

    @staticmethod
    def _peak(pid: int) -> int:
        try:
            lines = Path(f"/proc/{pid}/status").read_text().splitlines()
        except FileNotFoundError:
            return 0
        return 1024 * next((int(line.split()[1]) for line in lines if line.startswith("VmPeak")), 0)


def seconds(work: Callable[[], object], times: int) -> float:
    taken = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        taken.append(time.perf_counter() - start)
    return median(taken)


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--small-only", action="store_true")
    small_only = arguments.parse_args().small_only
    readers = FileReaders(1, 8 * 2**30, 600.0)
    print(f"the program is ready after {seconds(readers.start, 1):.2f} s")
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    print(f"{'file':>22} {'MiB':>6} {'samples':>9} {'here':>9} {'process':>9} {'ratio':>6} {'more':>8} {'memory':>9}")
    for format, make in MAKERS.items():
        for data, times in ((make(2000), 15), *([] if small_only else [(at_the_limit(make), 1)])):
            order = SurveyOrder(data, format, "building", 0.0)
            samples = len(read_on_floor(order).samples)
            here = seconds(lambda order=order: read_on_floor(order), times)
            with Peak(int(children[0])) as peak:
                there = seconds(lambda order=order: readers.survey(order), times)
            print(
                f"{format:>22} {len(data) / 2**20:6.1f} {samples:9,} {1e3 * here:6.0f} ms {1e3 * there:6.0f} ms "
                f"{there / here:6.2f} {1e3 * (there - here):5.0f} ms {peak.bytes / 2**20:5.0f} MiB"
            )
    readers.close()


if __name__ == "__main__":
    main()
