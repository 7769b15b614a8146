"""A track's state as bytes and back, exactly: what is followed from either is the same, bit for bit.

A NumPy archive (npz) without pickles: every array as it is, and a header in JSON that says which value each of them is.
Arrays come back in the order their elements had in memory, because sums of another order differ in the last bit.
"""

import json
from dataclasses import fields, is_dataclass
from io import BytesIO
from typing import Any, get_args, get_type_hints
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from app.errors import CorruptArtefact
from app.tracking.track_state import TrackState

__all__ = ["state_from_bytes", "state_nbytes", "state_to_bytes"]

_HEADER = "header"
_AXES = 32  # more than an array can have


def state_to_bytes(state: TrackState) -> bytes:
    """The whole state. Equal states give equal bytes."""
    arrays: list[NDArray[Any]] = []
    header = json.dumps(_told(state, arrays)).encode()
    file = BytesIO()
    named = {f"a{k}": array for k, array in enumerate(arrays)}
    np.savez(file, allow_pickle=False, **{_HEADER: np.frombuffer(header, dtype=np.uint8), **named})
    return file.getvalue()


def state_from_bytes(data: bytes) -> TrackState:
    """Raises CorruptArtefact, also for a state that another version wrote with other fields."""
    try:
        with np.load(BytesIO(data), allow_pickle=False) as archive:
            header = json.loads(archive[_HEADER].tobytes())
            arrays = [archive[f"a{k}"] for k in range(len(archive.files) - 1)]
        state = _made(header, arrays)
    except (BadZipFile, ValueError, KeyError, TypeError, IndexError, EOFError, OSError) as error:
        raise CorruptArtefact(f"a stored track state cannot be read: {error}; follow its steps again") from error
    if not isinstance(state, TrackState):
        raise CorruptArtefact("a stored track state was expected; follow its steps again")
    return state


def state_nbytes(state: TrackState) -> int:
    """Memory that a state holds, nearly: that of its particles and of the places they remember."""
    held = 0 if state.particles is None else state.particles.rows.nbytes + 16 * len(state.particles)
    return held + (0 if state.lag is None else state.lag.position_m.nbytes + state.lag.floor.nbytes)


def _told(value: Any, arrays: list[NDArray[Any]]) -> Any:
    """A value as JSON; arrays are put aside."""
    if is_dataclass(value) and type(value).__name__ in _KINDS:
        named = {field.name: _told(getattr(value, field.name), arrays) for field in fields(value)}
        return {"kind": type(value).__name__, "fields": named}
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        order = sorted(range(array.ndim), key=lambda axis: -abs(array.strides[axis]))
        arrays.append(np.ascontiguousarray(array.transpose(order)).reshape([array.shape[axis] for axis in order]))
        return {"array": len(arrays) - 1, "order": order, "scalar": isinstance(value, np.generic)}
    if isinstance(value, tuple):
        return {"tuple": [_told(each, arrays) for each in value]}
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a track's state holds a {type(value).__name__}, which is not stored")


def _made(told: Any, arrays: list[NDArray[Any]]) -> Any:
    if not isinstance(told, dict):
        return told
    if "kind" in told:
        return _KINDS[told["kind"]](**{name: _made(each, arrays) for name, each in told["fields"].items()})
    if "tuple" in told:
        return tuple(_made(each, arrays) for each in told["tuple"])
    array = arrays[told["array"]].transpose(np.argsort(told["order"][:_AXES]))
    return array[()] if told["scalar"] else array


def _dataclasses_in(kind: Any) -> dict[str, type[Any]]:
    """Every dataclass a field's type mentions, however deep, by name."""
    found: dict[str, type[Any]] = {}
    waiting = [kind]
    while waiting:
        each = waiting.pop()
        waiting += get_args(each)
        if isinstance(each, type) and is_dataclass(each) and each.__name__ not in found:
            found[each.__name__] = each
            waiting += get_type_hints(each).values()
    return found


_KINDS = _dataclasses_in(TrackState)
