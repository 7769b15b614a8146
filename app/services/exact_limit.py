"""Whether surveys are few enough for engine `exact`: asked before a map is, and again as a floor grows."""

from collections.abc import Iterable

from app.field.exact import MAX_OBSERVATIONS
from app.field.observations import STRETCH_M, count_observations
from app.field.samples import Samples

__all__ = ["TOO_MANY", "outgrow_exact"]

TOO_MANY = (
    f"engine exact takes at most {MAX_OBSERVATIONS} observations, {STRETCH_M:g} m of a walk each, and these surveys "
    "hold more"
)


def outgrow_exact(walks: Iterable[Samples]) -> bool:
    """Whether the walks hold more observations than engine exact takes; no more of them are read than it needs."""
    count = 0
    for samples in walks:
        count += count_observations(samples)
        if count > MAX_OBSERVATIONS:
            return True
    return False
