"""Rows as lines of JSON that mean the same whatever database they come from or go to.

A line is an object by column. Times are ISO 8601 in UTC, bytes base64; a JSON column is the text that is stored, as a
string, so that its numbers stay as they are and SQL's NULL differs from JSON's null; numbers that JSON has not are
their names ("nan", "inf").
"""

import json
from base64 import b64decode, b64encode
from collections.abc import Iterable, Iterator, Mapping
from datetime import UTC, datetime
from math import isfinite
from typing import Any

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Connection,
    DateTime,
    Float,
    Integer,
    LargeBinary,
    String,
    Table,
    Text,
    TypeDecorator,
    cast,
    column,
    insert,
    select,
    table,
)
from sqlalchemy.types import NullType, TypeEngine

from app.db.tables import UtcDateTime

__all__ = ["Columns", "columns_of", "insert_rows", "row_as_line", "row_from_line", "rows_of"]

Columns = Mapping[str, str]
"""The kind of each column by its name: text, int, bool, float, time, bytes, json."""

_KINDS: tuple[tuple[type[TypeEngine[Any]], str], ...] = (
    (JSON, "json"), (LargeBinary, "bytes"), (DateTime, "time"), (Boolean, "bool"), (Integer, "int"), (Float, "float"),
    (String, "text"),
)  # fmt: skip
_BOUND: Mapping[str, TypeEngine[Any]] = {
    "text": Text(), "int": BigInteger(), "bool": Boolean(), "float": Float(53), "time": UtcDateTime(),
    "bytes": LargeBinary(), "json": NullType(),  # of no type: the database takes the text for what its column is
}  # fmt: skip
_PYTHON = {"text": str, "int": int, "bool": bool, "json": str}
_BATCH_ROWS, _BATCH_BYTES = 500, 4 * 2**20


def columns_of(of: Table) -> Columns:
    """The kinds of a table's columns, also of one that was read from a database. Raises TypeError for other types."""
    return {each.name: _kind(each.type) for each in of.columns}


def _kind(of: TypeEngine[Any]) -> str:
    told = of.impl_instance if isinstance(of, TypeDecorator) else of
    for kind, name in _KINDS:
        if isinstance(told, kind):
            return name
    raise TypeError(f"columns of type {told!r} have no portable form yet")


def rows_of(connection: Connection, of: Table) -> Iterator[dict[str, Any]]:
    """Every row, in order of the primary key, a few at a time."""
    asked = [cast(each, Text).label(each.name) if _kind(each.type) == "json" else each for each in of.columns]
    statement = select(*asked).order_by(*of.primary_key.columns)
    for row in connection.execution_options(yield_per=_BATCH_ROWS).execute(statement).mappings():
        yield dict(row)


def insert_rows(connection: Connection, name: str, columns: Columns, lines: Iterable[bytes]) -> int:
    """Insert rows from their lines, a batch at a time, and return how many. Raises ValueError for a wrong line."""
    into = insert(table(name, *[column(each, _BOUND[kind]) for each, kind in columns.items()]))
    rows, size, count = [], 0, 0
    for line in lines:
        rows.append(row_from_line(columns, line))
        size, count = size + len(line), count + 1
        if len(rows) >= _BATCH_ROWS or size > _BATCH_BYTES:
            connection.execute(into, rows)
            rows, size = [], 0
    if rows:
        connection.execute(into, rows)
    return count


def row_as_line(columns: Columns, row: Mapping[str, Any]) -> bytes:
    """One line, with its end."""
    told = {name: None if row[name] is None else _told(kind, row[name]) for name, kind in columns.items()}
    return json.dumps(told, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def row_from_line(columns: Columns, line: bytes) -> dict[str, Any]:
    """The row in a line. Raises ValueError where it has other columns, or values that are not of their kind."""
    told = json.loads(line)
    if not isinstance(told, dict) or told.keys() != columns.keys():
        raise ValueError(f"a row should have the columns {', '.join(columns)}")
    return {name: None if told[name] is None else _meant(kind, name, told[name]) for name, kind in columns.items()}


def _told(kind: str, value: Any) -> Any:
    if kind == "time":
        return value.astimezone(UTC).isoformat()
    if kind == "bytes":
        return b64encode(value).decode()
    if kind == "float" and not isfinite(value):
        return repr(float(value))
    return value


def _meant(kind: str, name: str, told: Any) -> Any:
    if kind == "float" and type(told) in (int, float, str):
        return float(told)
    if kind == "time" and type(told) is str:
        return datetime.fromisoformat(told)
    if kind == "bytes" and type(told) is str:
        return b64decode(told, validate=True)
    if type(told) is not _PYTHON.get(kind):
        raise ValueError(f"column {name}: {str(told)[:60]!r} is no {kind}")
    return told
