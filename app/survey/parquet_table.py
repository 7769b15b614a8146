"""Surveys as Parquet, read from memory."""

from app.errors import Fault, UnreadableSurvey
from app.field.samples import SampleFrame
from app.geometry import Array
from app.survey.columns import Columns, check_sample_count, columns_to_read, numbers_of

__all__ = ["read_parquet"]

_THRIFT_STRING_LIMIT, _THRIFT_CONTAINER_LIMIT = 2**20, 2**16


def read_parquet(data: bytes, frame: SampleFrame) -> Columns:
    """The columns of a Parquet file. Raises UnreadableSurvey, and TooLarge before any column is read."""
    import pyarrow as pa
    from pyarrow import parquet

    if not data:
        raise UnreadableSurvey("the file is empty", Fault("file", "0 bytes"))
    if data[:4] != b"PAR1" or data[-4:] != b"PAR1":
        what = "it does not start with" if data[:4] != b"PAR1" else "it was cut: it does not end with"
        raise UnreadableSurvey(f"the file is no whole Parquet file: {what} PAR1", Fault("file", f"{what} PAR1"))
    try:
        file = parquet.ParquetFile(
            pa.BufferReader(data),
            page_checksum_verification=True,
            thrift_string_size_limit=_THRIFT_STRING_LIMIT,
            thrift_container_size_limit=_THRIFT_CONTAINER_LIMIT,
        )
        check_sample_count(file.metadata.num_rows)
        schema = file.schema_arrow
        wanted = columns_to_read(schema.names, frame)
        for name in wanted:
            _check_type(schema, name)
        table = file.read(columns=list(wanted), use_threads=False)
    except (pa.ArrowException, OSError, ValueError, KeyError, MemoryError) as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise UnreadableSurvey(f"the Parquet file is corrupt: {reason}", Fault("file", reason)) from error
    values: dict[str, Array] = {}
    for name in wanted:
        # Nulls become NaN, which the common checks then refuse with row and column.
        values[name] = numbers_of(table.column(name).cast(pa.float64(), safe=False))
    return Columns(values, lambda i: f"row {i + 1}")


def _check_type(schema: object, name: str) -> None:
    from pyarrow import types

    if schema.names.count(name) > 1:  # type: ignore[attr-defined]
        raise UnreadableSurvey(f"the file has the column {name} twice", Fault(f"column {name}", "twice"))
    kind = schema.field(name).type  # type: ignore[attr-defined]
    if not (types.is_floating(kind) or types.is_integer(kind)):
        raise UnreadableSurvey(
            f"column {name} holds {str(kind)[:60]}, not numbers; store it as double",
            Fault(f"column {name}", f"type {str(kind)[:60]}"),
        )
