"""What the viewer asks of the rest of the house: who is signed in, and what may be shown to them.

The page never sees the database. The composition root hands it one callable (key to identity) and one `ViewerSource`;
every question carries the reach of whoever asks, so an answer can only ever be about objects within it.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from app.field.grid import FieldGrid
from app.field.samples import Samples
from app.geometry import Array
from app.services.reach import Reach
from app.viewer.layers import StoredLayers

__all__ = [
    "Authenticate",
    "Identity",
    "PlacedPlan",
    "ViewedBuilding",
    "ViewedFloor",
    "ViewedMap",
    "ViewerSource",
    "Walk",
    "may_view",
]


class Identity(Protocol):
    """Whoever a key belongs to."""

    @property
    def reach(self) -> Reach: ...

    @property
    def scopes(self) -> Collection[str]: ...


Authenticate = Callable[[str], Identity | None]
"""An API key to its identity, or None when there is no such key or it was revoked. May block: called off the loop."""


def may_view(identity: Identity) -> bool:
    """Whether the scopes of an identity let it see maps."""
    return "map:read" in identity.scopes or "admin" in identity.scopes


@dataclass(frozen=True, slots=True)
class PlacedPlan:
    """A picture of a floor and where it lies: its sides in m, building x, y of its lower left corner in m, and the
    direction of its lower side in rad, counter-clockwise from the building's x. The picture stays under its hash."""

    sha256: str
    width_m: float
    height_m: float
    x_m: float
    y_m: float
    bearing_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class ViewedFloor:
    """A floor as the page needs it. `rings_m`: outline, each (k, 2) in building metres, closed; () when unknown.

    map_id, grid_sha256 are None while the floor has no active map, `plan` while it has no picture.
    """

    id: str
    name: str
    ordinal: int
    elevation_m: float
    rings_m: tuple[Array, ...] = ()
    map_id: str | None = None
    grid_sha256: str | None = None
    plan: PlacedPlan | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ViewedBuilding:
    """A building and its floors, lowest first."""

    id: str
    name: str
    floors: tuple[ViewedFloor, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ViewedMap:
    """A finished map of a floor: its grid, and what the fit left beside it (layers (nz, ny, nx) by name)."""

    floor_id: str
    grid: FieldGrid
    stored: StoredLayers = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        return self.grid.nbytes + sum(layer.nbytes for layer in self.stored.values())


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """One survey walk, thinned for the eye."""

    survey_id: str
    name: str
    samples: Samples

    @property
    def p_building_m(self) -> Array:
        return self.samples.p_building_m


class ViewerSource(Protocol):
    """What can be shown to somebody, by their reach. Called from worker threads, several at once."""

    def buildings(self, reach: Reach) -> list[ViewedBuilding]:
        """Every building within reach, by name."""
        ...

    def map(self, reach: Reach, map_id: str) -> ViewedMap:
        """A map. Raises NotFound for one that is not ready or not within reach."""
        ...

    def walks(self, reach: Reach, floor_id: str, known: Mapping[str, Walk]) -> list[Walk]:
        """The walks that count towards a floor's map; those in `known` (by survey id) are not read again.

        Raises NotFound for a floor that is not within reach.
        """
        ...

    def plan_image(self, reach: Reach, floor_id: str) -> bytes:
        """The picture of a floor's plan, PNG or WebP. Raises NotFound for a floor that has none or is not
        within reach."""
        ...
