"""A row is the same after its line, whatever is in it, on both databases."""

import json
import math
from datetime import UTC, datetime, timedelta, timezone
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Engine,
    Float,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Uuid,
    cast,
    insert,
    select,
    text,
)

from app.db.portable_rows import columns_of, insert_rows, row_as_line, row_from_line, rows_of
from app.db.tables import Base, UtcDateTime

ODD = Table(
    "odd_rows", MetaData(),
    Column("id", Integer, primary_key=True), Column("text", String(200)), Column("big", BigInteger),
    Column("flag", Boolean), Column("number", Float(53)), Column("time", UtcDateTime), Column("data", LargeBinary),
    Column("json", JSON),
)  # fmt: skip
KINDS = columns_of(ODD)

numbers = st.floats(allow_nan=False)
times = st.datetimes(min_value=datetime(1, 1, 2), max_value=datetime(9999, 12, 30)).flatmap(
    lambda at: st.integers(-14, 14).map(lambda hours: at.replace(tzinfo=timezone(timedelta(hours=hours))))
)
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=40)  # NUL: not PostgreSQL
documents = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)
rows = st.fixed_dictionaries({
    "text": st.none() | texts,
    "big": st.none() | st.integers(-(2**63), 2**63 - 1),
    "flag": st.none() | st.booleans(),
    "number": st.none() | numbers,
    "time": st.none() | times,
    "data": st.none() | st.binary(max_size=60),
    # objects and lists, as every column of ours has; and JSON's null beside SQL's
    "json": st.none() | (st.dictionaries(texts, documents, max_size=3) | st.lists(documents, max_size=3)
                         | st.none()).map(json.dumps),
})  # fmt: skip


@pytest.fixture(scope="module")
def odd(engine: Engine) -> Engine:
    ODD.metadata.create_all(engine)
    return engine


@given(rows)
def test_a_row_comes_back_from_its_line(row: dict[str, Any]) -> None:
    row = {"id": 1, **row}
    line = row_as_line(KINDS, row)
    assert line.count(b"\n") == 1
    assert line.endswith(b"\n")
    back = row_from_line(KINDS, line)
    assert back == row
    assert {name: type(value) for name, value in back.items()} == {name: type(row[name]) for name in row}
    if row["number"] is not None:
        assert math.copysign(1, back["number"]) == math.copysign(1, row["number"])


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(many=st.lists(rows, min_size=1, max_size=6))
@example(many=[dict.fromkeys(set(KINDS) - {"id"}) | {"number": -0.0}])
def test_rows_come_back_from_a_database(odd: Engine, many: list[dict[str, Any]]) -> None:
    if odd.dialect.name == "sqlite":  # which itself keeps no sign of a zero
        many = [row if row["number"] is None else row | {"number": row["number"] + 0.0} for row in many]
    lines = [row_as_line(KINDS, {"id": number, **row}) for number, row in enumerate(many)]
    with odd.begin() as connection:
        connection.execute(ODD.delete())
        assert insert_rows(connection, ODD.name, KINDS, lines) == len(lines)
    with odd.connect() as connection:
        assert [row_as_line(KINDS, row) for row in rows_of(connection, ODD)] == lines


def test_what_the_orm_stored_and_what_a_restore_stores_are_the_same(odd: Engine) -> None:
    row = {"id": 7, "text": "é", "big": 1, "flag": True, "number": 0.1, "time": datetime.now(UTC), "data": b"\0",
           "json": {"a": [1.5, None, "é"]}}  # fmt: skip
    raw = select(*[cast(text(f'"{each.name}"'), String) for each in ODD.columns if each.name != "data"]).select_from(
        ODD
    )
    seen = []
    line = b""
    for by_the_orm in (True, False):
        with odd.begin() as connection:
            connection.execute(ODD.delete())
            if by_the_orm:
                connection.execute(insert(ODD), row)
            else:
                insert_rows(connection, ODD.name, KINDS, [line])
            (line,) = [row_as_line(KINDS, each) for each in rows_of(connection, ODD)]
            seen.append(connection.execute(raw).all())
            assert connection.execute(select(ODD)).mappings().one() == row
    assert seen[0] == seen[1]


def test_more_rows_than_a_batch(odd: Engine) -> None:
    empty = dict.fromkeys(KINDS)
    lines = (row_as_line(KINDS, empty | {"id": number, "data": b"x" * 9000}) for number in range(1234))
    with odd.begin() as connection:
        connection.execute(ODD.delete())
        assert insert_rows(connection, ODD.name, KINDS, lines) == 1234
        assert [row["id"] for row in rows_of(connection, ODD)] == list(range(1234))


@pytest.mark.parametrize("wrong", [
    b"[]", b"{}", b"{", b"\xff", b'{"id":1,"text":"x","more":2}', b'{"id":"1","text":null}', b'{"id":true,"text":null}',
    b'{"id":1,"text":5}',
])  # fmt: skip
def test_a_wrong_line_is_refused(wrong: bytes) -> None:
    with pytest.raises(ValueError):
        row_from_line({"id": "int", "text": "text"}, wrong)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_numbers_that_json_has_not(value: float) -> None:
    back = row_from_line({"x": "float"}, row_as_line({"x": "float"}, {"x": value}))["x"]
    assert repr(back) == repr(value)


def test_every_column_of_ours_has_a_kind() -> None:
    for table in Base.metadata.sorted_tables:
        assert columns_of(table)
    with pytest.raises(TypeError, match="portable"):
        columns_of(Table("t", MetaData(), Column("x", Uuid)))
