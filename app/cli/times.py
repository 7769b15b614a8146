"""Spans of time and times as people write them on a command line: 90m, 24h, 7d, 2030-01-31."""

import re
from datetime import UTC, datetime, timedelta

import typer

__all__ = ["read_duration", "read_time"]

_UNITS = {"m": "minutes", "h": "hours", "d": "days"}


def read_duration(told: str) -> timedelta:
    """Raises BadParameter for what is no duration."""
    found = re.fullmatch(r"(\d{1,6})([mhd])", told.strip())
    if found is None:
        raise typer.BadParameter(f"{told!r} is no duration; use minutes, hours or days as in 90m, 24h or 7d")
    return timedelta(**{_UNITS[found[2]]: int(found[1])})


def read_time(told: str, *, ago: bool = False) -> datetime:
    """A date (its start) or a time, in UTC unless it says otherwise; or a duration from now. Raises BadParameter."""
    try:
        at = datetime.fromisoformat(told)
    except ValueError:
        span = read_duration(told)
        return datetime.now(UTC) - span if ago else datetime.now(UTC) + span
    return at.replace(tzinfo=UTC) if at.tzinfo is None else at.astimezone(UTC)
