"""How far somebody reaches: the things of an organisation, or only those of some of its buildings."""

from dataclasses import dataclass

__all__ = ["Reach"]


@dataclass(frozen=True, slots=True)
class Reach:
    """What can be seen and touched. `building_ids`: these and all below them; None is everything."""

    organisation_id: str
    building_ids: frozenset[str] | None = None

    def holds(self, organisation_id: str, building_id: str) -> bool:
        """Whether a building of an organisation, or what is below it, is within reach."""
        within = self.building_ids is None or building_id in self.building_ids
        return within and organisation_id == self.organisation_id
