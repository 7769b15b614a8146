"""Surveys as comma-separated text: fast by Arrow, and when Arrow refuses, slowly, to say where and why."""

import csv
import io
from collections.abc import Iterator

import numpy as np

from app.errors import Fault, UnreadableSurvey
from app.field.samples import SampleFrame
from app.survey.columns import MAX_FAULTS, Columns, check_sample_count, columns_to_read, numbers_of

__all__ = ["read_csv"]


def read_csv(data: bytes, frame: SampleFrame) -> Columns:
    """The columns of a CSV file. Raises UnreadableSurvey with line and column, TooLarge."""
    text = decode_utf8(data)
    check_sample_count(max(data.count(b"\n"), data.count(b"\r")))
    first, header = _header(text)
    wanted = columns_to_read(header, frame)
    columns = _read_fast(text, first, header, wanted)
    return columns if columns is not None else _read_slowly(text, header, wanted)


def decode_utf8(data: bytes) -> str:
    """Text without byte-order mark. Raises UnreadableSurvey for anything that is no UTF-8 text, or empty."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise UnreadableSurvey(
            f"the file is not UTF-8 text (line {line}); save it as UTF-8, or name the format it really has",
            Fault(f"line {line}", f"byte 0x{data[error.start]:02x} is not UTF-8"),
        ) from error
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise UnreadableSurvey(
            f"the file is not text: line {line} holds a zero byte", Fault(f"line {line}", "a zero byte")
        )
    if not text.strip():
        raise UnreadableSurvey("the file is empty", Fault("file", "no text"))
    return text


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """The lines that are not blank, each with its number from 1."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    return ((number, line) for number, line in enumerate(lines, start=1) if line.strip())


def _header(text: str) -> tuple[int, list[str]]:
    """The number of the header's line, and the column names on it."""
    number, line = next(_lines(text))
    names = [name.strip().strip('"').strip() for name in line.split(",")]
    twice = sorted({name for name in names if names.count(name) > 1 and name})
    if twice:
        raise UnreadableSurvey(
            f"the header names {twice[0][:40]} twice; name each column once",
            Fault(f"line {number}", f"{twice[0][:40]} twice"),
        )
    for separator, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) == 1 and separator in names[0]:
            raise UnreadableSurvey(f"the columns are separated by {name}; use commas", Fault(f"line {number}", name))
    return number, names


def _read_fast(text: str, first: int, header: list[str], wanted: tuple[str, ...]) -> Columns | None:
    """Arrow's reading, or None where it would refuse or would guess."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    try:
        table = arrow_csv.read_csv(
            pa.BufferReader(text.encode()),
            read_options=arrow_csv.ReadOptions(use_threads=False, column_names=header, skip_rows=first),
            parse_options=arrow_csv.ParseOptions(quote_char=False),
            convert_options=arrow_csv.ConvertOptions(
                column_types=dict.fromkeys(wanted, pa.float64()), include_columns=list(wanted), null_values=[]
            ),
        )
    except (pa.ArrowException, ValueError):
        return None
    values = {name: numbers_of(table.column(name)) for name in wanted}
    return Columns(values, _LineNumbers(text))


def _read_slowly(text: str, header: list[str], wanted: tuple[str, ...]) -> Columns:
    """Line by line. Raises UnreadableSurvey with every faulty cell up to the limit."""
    body = list(_lines(text))[1:]
    places = [(header.index(name), name) for name in wanted]
    rows: list[list[float]] = []
    faults: list[Fault] = []
    for number, line in body:
        cells = next(csv.reader(io.StringIO(line)), [])
        if len(cells) != len(header):
            hint = "; the file looks truncated" if number == body[-1][0] and len(cells) < len(header) else ""
            faults.append(Fault(f"line {number}", f"{len(cells)} values, the header names {len(header)}{hint}"))
        else:
            row = [_number(cells[place]) for place, _ in places]
            rows.append([x if x is not None else np.nan for x in row])
            faults += [
                Fault(f"line {number}, column {name}", f"{cells[place].strip()[:40]!r} is not a number")
                for (place, name), x in zip(places, row, strict=True)
                if x is None
            ]
        if len(faults) >= MAX_FAULTS:
            break
    if faults:
        raise UnreadableSurvey(
            f"the table cannot be read at {faults[0].location}: {faults[0].reason}", *faults[:MAX_FAULTS]
        )
    table = np.asarray(rows, dtype=np.float64).reshape(len(rows), len(wanted))
    numbers = [number for number, _ in body]
    return Columns({name: table[:, k] for k, name in enumerate(wanted)}, lambda i: f"line {numbers[i]}")


def _number(cell: str) -> float | None:
    try:
        return None if "_" in cell else float(cell)
    except ValueError:
        return None


class _LineNumbers:
    """Where row i of the body stands, counting lines only when somebody asks."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._numbers: list[int] | None = None

    def __call__(self, row: int) -> str:
        if self._numbers is None:
            self._numbers = [number for number, _ in _lines(self._text)][1:]
        return f"line {self._numbers[row]}" if row < len(self._numbers) else f"row {row + 1}"
