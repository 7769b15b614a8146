"""What the doctor says of one thing."""

from dataclasses import dataclass

__all__ = ["Finding"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at: `ok` True, False (broken) or None (works, could be better), and what to do."""

    what: str
    ok: bool | None
    seen: str
    advice: str = ""
