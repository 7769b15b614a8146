"""Field types that requests and responses share: bounded, finite, free of control characters."""

from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import Path
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, StringConstraints

__all__ = ["AppliedView", "Finite", "Id", "Metres", "Name", "Point", "RequestModel", "Seconds", "Time", "unchanged"]

Finite = Annotated[float, Field(allow_inf_nan=False)]
Seconds = Annotated[float, Field(allow_inf_nan=False, ge=-1e11, le=1e11)]
Metres = Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Point = Annotated[list[Metres], Field(min_length=3, max_length=3, examples=[[12.3, 4.5, 1.2]])]
Name = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
Id = Annotated[str, Path(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_-]+$", description="an opaque id")]


def _in_utc(time: datetime) -> datetime:
    """As it is kept. The first and the last hours of the calendar have no such time in some zones."""
    try:
        return time.astimezone(UTC)
    except OverflowError:
        raise ValueError("this time is off the calendar in UTC") from None


Time = Annotated[AwareDatetime, AfterValidator(_in_utc)]


class RequestModel(BaseModel):
    """A request body: unknown names are refused, so that a misspelt option is never silently ignored."""

    model_config = ConfigDict(extra="forbid")


class AppliedView(BaseModel):
    """The calibration that was applied to readings."""

    id: str
    device: str
    version: int


def unchanged() -> Any:
    """The default of a PATCH's field: what is not given stays. A null is another thing, and refused unless typed so.

    Read such bodies by `model_dump(exclude_unset=True)`.
    """
    return Field(default_factory=lambda: None)
