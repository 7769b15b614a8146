"""What a page asks its scene for, as it comes from the browser: checked here, believed from here on."""

from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

__all__ = ["ASKED_BY", "CameraPose", "Ellipse", "Likelihood", "Marks", "Mode", "Path", "Shown", "Target"]

Id = Annotated[str, Field(max_length=64)]
Finite = Annotated[float, Field(allow_inf_nan=False, ge=-1e6, le=1e6)]
Point = Annotated[list[Finite], Field(min_length=3, max_length=3)]
_MOST_CELLS = 40_000


class _Asked(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CameraPose(_Asked):
    """Where the camera is and what it looks at, building metres."""

    position_m: Point
    look_at_m: Point


class Shown(_Asked):
    """What is to be seen. Ids that are not the organisation's are passed over, and the picture says so.

    floor_id      None: every floor of the building
    map_id        of that floor, None: the active one
    versus_id     the other map of the layer `difference`
    height_m      of the map; None: its lowest
    walks         None: unless they lie so close that they would hide the field
    separation_m  added between floors; None: as much as shows each floor
    aspect        width of the canvas by its height, which the usual camera takes into account
    """

    building_id: Id | None = None
    floor_id: Id | None = None
    map_id: Id | None = None
    versus_id: Id | None = None
    layer: Annotated[str, Field(max_length=40)] = "norm"
    height_m: Finite | None = None
    arrows: bool = True
    walks: bool | None = None
    outline: bool = True
    plan: bool = True
    separation_m: Annotated[float, Field(ge=0, le=100)] | None = None
    camera: Literal["keep", "oblique", "top"] | CameraPose = "keep"
    aspect: Annotated[float, Field(ge=0.1, le=10)] = 1.3


ASKED_BY = {"building": "building_id", "floor": "floor_id", "map": "map_id", "versus": "versus_id", "layer": "layer",
            "height": "height_m"}  # fmt: skip
"""The fields of `Shown` by their names in a deep link."""


class Target(_Asked):
    """A point of the picture: u from the left, v from the top; `surveys`: also which surveys came near."""

    u: Annotated[float, Field(ge=0, le=1)]
    v: Annotated[float, Field(ge=0, le=1)]
    surveys: bool = False


class Likelihood(_Asked):
    """Log-likelihood (ny, nx) less the best, nats; null far below. As `explanation.likelihood` of an answer."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    floor_id: Id
    height_m: Finite
    origin_m: Annotated[list[Finite], Field(min_length=2, max_length=2)]
    resolution_m: Annotated[float, Field(gt=0, le=1000)]
    log_likelihood: Annotated[
        list[Annotated[list[Finite | None], Field(min_length=1, max_length=_MOST_CELLS)]],
        Field(min_length=1, max_length=_MOST_CELLS),
    ]

    @model_validator(mode="after")
    def _is_a_grid(self) -> Self:
        columns = {len(row) for row in self.log_likelihood}
        if len(columns) != 1 or len(self.log_likelihood) * max(columns) > _MOST_CELLS:
            raise ValueError(f"rows must be equally long, at most {_MOST_CELLS:,} cells in all")
        return self


class Mode(_Asked):
    """label: said beside it instead of its share."""

    model_config = ConfigDict(frozen=True, extra="ignore")
    floor_id: Id
    position_m: Point
    probability: Annotated[float, Field(ge=0, le=1)]
    heading_rad: Finite | None = None
    label: Annotated[str, Field(max_length=80)] | None = None


class Ellipse(_Asked):
    """The 95 % ellipse of a Gaussian belief about a position."""

    floor_id: Id
    position_m: Point
    covariance_m2: Annotated[
        list[Annotated[list[Finite], Field(min_length=2, max_length=2)]], Field(min_length=2, max_length=2)
    ]


class Path(_Asked):
    floor_id: Id
    kind: Literal["truth", "estimate"]
    points_m: Annotated[list[Point], Field(max_length=20_000)]


class Marks(_Asked):
    """What is drawn over the floors: an answer (of a window, or a walk replayed), or tracks that are being followed.

    Replaces what was there `of` the same kind, and leaves the other.
    """

    of: Literal["answer", "tracks"] = "answer"
    likelihood: Likelihood | None = None
    modes: Annotated[list[Mode], Field(max_length=64)] = []
    ellipses: Annotated[list[Ellipse], Field(max_length=64)] = []
    paths: Annotated[list[Path], Field(max_length=64)] = []

    def __bool__(self) -> bool:
        return bool(self.likelihood or self.modes or self.ellipses or self.paths)

    def floors(self) -> set[str]:
        """The floors anything is drawn on."""
        each: list[Any] = [*self.modes, *self.ellipses, *self.paths]
        return {item.floor_id for item in each} | ({self.likelihood.floor_id} if self.likelihood else set())
