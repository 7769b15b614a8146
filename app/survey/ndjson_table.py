"""Surveys as newline-delimited JSON: one object per line, named as the columns."""

import json
from collections.abc import Iterator

import numpy as np

from app.errors import Fault, UnreadableSurvey
from app.field.samples import SampleFrame
from app.survey.columns import MAX_FAULTS, Columns, check_sample_count, columns_to_read
from app.survey.csv_table import decode_utf8

__all__ = ["read_ndjson"]


def read_ndjson(data: bytes, frame: SampleFrame) -> Columns:
    """The columns of an NDJSON file; the first object says which there are. Raises UnreadableSurvey, TooLarge."""
    text = decode_utf8(data)
    check_sample_count(data.count(b"\n"))
    lines = [(number, line) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    first = _parse(lines[0][1])
    if isinstance(first, str):
        raise UnreadableSurvey(f"line {lines[0][0]} is not a JSON object: {first}", Fault("line 1", first))
    wanted = columns_to_read(first, frame)
    rows: list[list[float]] = []
    faults: list[Fault] = []
    last = lines[-1][0]
    for number, line in lines:
        record = _parse(line)
        if isinstance(record, str):
            hint = "; the file looks truncated" if number == last else ""
            faults.append(Fault(f"line {number}", record + hint))
        else:
            faults += [Fault(f"line {number}, column {name}", reason) for name, reason in _wrong(record, wanted)]
            if not faults:
                rows.append([record[name] for name in wanted])  # type: ignore[misc]
        if len(faults) >= MAX_FAULTS:
            break
    if faults:
        raise UnreadableSurvey(
            f"the file cannot be read at {faults[0].location}: {faults[0].reason}", *faults[:MAX_FAULTS]
        )
    table = np.asarray(rows, dtype=np.float64)
    numbers = [number for number, _ in lines]
    return Columns({name: table[:, k] for k, name in enumerate(wanted)}, lambda i: f"line {numbers[i]}")


def _parse(line: str) -> dict[str, object] | str:
    """The object on a line, or why there is none."""
    try:
        record = json.loads(line)
    except json.JSONDecodeError as error:
        return f"{error.msg} at column {error.colno}"
    except (ValueError, RecursionError):
        return "a number too long or brackets nested too deep"
    return record if isinstance(record, dict) else "one JSON object is expected on each line"


def _wrong(record: dict[str, object], wanted: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """The columns of a record that are no numbers, with the reason."""
    for name in wanted:
        value = record.get(name)
        if value is None:
            yield name, "missing" if name not in record else "null"
        elif type(value) is int and abs(value) > 10**300:
            yield name, "not finite"
        elif type(value) not in (int, float):
            yield name, f"{str(value)[:40]!r} is not a number"
