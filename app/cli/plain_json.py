"""Results as JSON that every reader takes: null for what is infinite or not a number."""

import json
import math
from pathlib import Path
from typing import Any

__all__ = ["write_json"]


def write_json(file: Path, document: dict[str, Any]) -> None:
    file.write_text(json.dumps(_finite(document), indent=1, allow_nan=False) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
