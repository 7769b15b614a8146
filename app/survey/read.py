"""Bytes of a survey file in, a walk out: the one entry to every format."""

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

from app.errors import Fault, UnreadableSurvey
from app.field.samples import SampleFrame
from app.geometry import Array
from app.survey.columns import Columns, samples_from_columns
from app.survey.csv_table import read_csv
from app.survey.indoor_location import read_indoor_location
from app.survey.ndjson_table import read_ndjson
from app.survey.parquet_table import read_parquet
from app.survey.quality import describe_samples, sample_warnings
from app.survey.walk import Walk

__all__ = ["FORMATS", "read_survey"]

_TABLES: dict[str, Callable[[bytes, SampleFrame], Columns]] = {
    "csv": read_csv,
    "parquet": read_parquet,
    "ndjson": read_ndjson,
}
FORMATS = (*_TABLES, "indoor-location-2020")


Correct = Callable[[Array], Array]
"""Readings (n, 3) in the sensor's axes, uT, to the field: a device's calibration."""


def read_survey(
    data: bytes,
    *,
    format: str,
    frame: SampleFrame = "building",
    session: str | None = None,
    correct: Correct | None = None,
) -> Walk:
    """Read one walk from the (decompressed) bytes of a survey file.

    format    one of `FORMATS`
    frame     what b is in a table without quaternions: "building", "level" or "norm"; traces find their own
    session   label of the sensor's calibration session (Samples.session): tables with quaternions; traces have theirs
    correct   the device's calibration: for files that have the readings in the sensor's own axes, tables with
              quaternions and traces (there it replaces the phone's own bias)

    Raises UnreadableSurvey with line, column and reason for anything that cannot be used, TooLarge beyond the most
    samples a survey may have (2,000,000). Nothing else.
    """
    if format not in FORMATS:
        raise UnreadableSurvey(
            f"unknown survey format {format[:40]!r}; known are {', '.join(FORMATS)}", Fault("format", "unknown")
        )
    if frame not in get_args(SampleFrame):
        raise UnreadableSurvey(
            f"unknown frame {frame[:40]!r}; known are {', '.join(get_args(SampleFrame))}", Fault("frame", "unknown")
        )
    if format == "indoor-location-2020":
        if correct is None:
            _refuse_session(session, "a trace says its calibration session itself, by the phone's own bias")
        return read_indoor_location(data, session, correct)
    samples, assumptions = samples_from_columns(_TABLES[format](data, frame), frame, correct)
    if samples.q_body_to_building is None:
        _refuse_session(session, "a sensor's offset is known in its own frame only: give qw,qx,qy,qz and b in it")
    samples = replace(samples, session=session)
    report: dict[str, object] = {
        "format": format,
        "session": session,
        **describe_samples(samples),
        "assumptions": assumptions,
        "warnings": sample_warnings(samples),
    }
    return Walk(samples, report)


def _refuse_session(session: str | None, reason: str) -> None:
    if session is not None:
        raise UnreadableSurvey(f"session cannot be said of this survey: {reason}", Fault("session", reason))
