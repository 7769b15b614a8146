"""How the errors of a walk against a map hang together along it: a constant, an Ornstein-Uhlenbeck process, white noise.

A window is a short walk, so its errors have the structure that surveys showed; what a window is worth as independent
samples follows from it.
"""

from dataclasses import dataclass

__all__ = ["UNKNOWN_STRUCTURE", "ErrorStructure", "strictest"]

MOST_SHARED = 0.98
"""Some of every error is white: without it two readings side by side would be worth infinitely much."""


@dataclass(frozen=True, slots=True)
class ErrorStructure:
    """Shares of the variance of one error: the correlation at a distance d walked is
    `constant_share + walk_share exp(-d / walk_length_m)`, and one at d = 0.
    """

    constant_share: float
    walk_share: float
    walk_length_m: float

    def __post_init__(self) -> None:
        assert self.constant_share >= 0.0, self
        assert self.walk_share >= 0.0, self
        assert self.constant_share + self.walk_share <= 1.0, self
        assert self.walk_length_m > 0.0, self

    @property
    def white_share(self) -> float:
        return 1.0 - self.constant_share - self.walk_share


UNKNOWN_STRUCTURE = ErrorStructure(0.2, 0.5, 2.0)
"""What errors are taken to be where no survey can be judged by another."""


def strictest(structures: list[ErrorStructure]) -> ErrorStructure:
    """One structure for floors that are compared with each other: the largest share of every kind, the longest length."""
    constant = max(each.constant_share for each in structures)
    walk = max(each.walk_share for each in structures)
    excess = max((constant + walk) / MOST_SHARED, 1.0)
    return ErrorStructure(constant / excess, walk / excess, max(each.walk_length_m for each in structures))
