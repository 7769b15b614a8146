"""How many windows could be accepted, the surest first, with most of them right."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.services.rates import Rate, rate

__all__ = ["MOST_RIGHT", "Acceptance", "reachable_acceptance"]

MOST_RIGHT = 0.9


@dataclass(frozen=True, slots=True)
class Acceptance:
    """The largest share of windows, taken by falling confidence, of which at least MOST_RIGHT are right; the confidence

    of the last of them (None where there are none). Found on the windows it is stated for: a little flattering.
    """

    accepted: Rate
    right: Rate
    least_confidence: float | None


def reachable_acceptance(confidence: Sequence[float], right: Sequence[bool], walks: Sequence[str]) -> Acceptance:
    """Windows as equally sure as the last accepted one are accepted with it."""
    sure = np.asarray(confidence)
    order = np.argsort(-sure, kind="stable")
    share = np.cumsum(np.asarray(right, dtype=np.float64)[order]) / np.arange(1, len(order) + 1)
    last_of_equals = np.append(sure[order][1:] < sure[order][:-1], True)[: len(order)]
    enough = np.flatnonzero((share >= MOST_RIGHT) & last_of_equals)
    least = float(sure[order][enough[-1]]) if len(enough) else None
    accepted = [least is not None and x >= least for x in confidence]
    chosen = [k for k, yes in enumerate(accepted) if yes]
    return Acceptance(rate(accepted, walks), rate([right[k] for k in chosen], [walks[k] for k in chosen]), least)
