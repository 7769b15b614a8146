"""What a web process and the process that reads one foreign file say to each other: JSON and plain arrays, no code.

An answer may come from a process that its file has taken over. It is believed only as far as it is checked here: its
kind, the type, shape and values of every array, and the size of all of it.
"""

import json
import struct
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from app.calibration.sensor_model import SensorModel
from app.errors import CorruptArtefact, Fault, InvalidInput, IsodynError, TooLarge, UnreadableSurvey
from app.field.samples import SampleFrame, Samples
from app.services.artefacts import pack, unpack
from app.services.file_orders import Order, PictureOrder, SurveyOrder
from app.services.receive_plan import LONGEST_SIDE_PX, MAX_PIXELS, Picture
from app.survey.columns import MAX_SAMPLES
from app.survey.walk import DeadReckoning, Walk

__all__ = ["CONTROL", "END", "FORK", "FORGET", "LENGTH", "MAX_ANSWER_BYTES", "NO_FAULT_OF_THE_FILE", "NUMBER",
           "OUT_OF_MEMORY", "answer_to_bytes", "failure_to_bytes", "order_header", "order_of", "refusal_to_bytes",
           "told"]  # fmt: skip

FORK, END, FORGET = 0, 1, 2
CONTROL = struct.Struct("<qqQ")
"""What, a number, memory in bytes. FORK comes with the child's socket and its processor seconds, and is answered by its
process id, or by minus the error where there can be none; END has that id: the child is killed if it still runs, and
the answer is its exit code, or minus the signal that ended it. FORGET is END without an answer."""
NUMBER = struct.Struct("<q")
LENGTH = struct.Struct("<Q")
"""Before an order's header, its file, and an answer."""

OUT_OF_MEMORY, NO_FAULT_OF_THE_FILE = 3, 4
"""Exit codes of a child that gave no answer."""
MAX_ANSWER_BYTES = 768 * 2**20
"""Samples and dead reckoning of the longest survey are less."""
MAX_REPORT_BYTES = 4 * 2**20
MAX_FAULTS, MAX_SENTENCE = 50, 4000
_REFUSALS: dict[str, type[IsodynError]] = {
    kind.__name__: kind for kind in (UnreadableSurvey, InvalidInput, TooLarge)
}  # fmt: skip
_SAMPLES = {"t_s": 0, "p_building_m": 3, "q_body_to_building": 4}
_RECKONING = {"displacement_m": 3, "yaw_rad": 0, "B_level_uT": 3, "q_body_to_level": 4}
_HEADING = ("heading_rad", "heading_sd_rad")
_STEPS = ("step_t_s", "step_length_m")


def order_header(order: Order) -> bytes:
    """An order but for the file itself, which follows as it is."""
    header: dict[str, Any] = {"what": type(order).__name__}
    if isinstance(order, SurveyOrder):
        header |= {name: getattr(order, name) for name in ("format", "frame", "elevation_m", "session")}
        model = order.correct
        header["correct"] = None if model is None else [model.hard_iron_uT.tolist(), model.correction.tolist()]
    return json.dumps(header).encode()


def order_of(header: bytes, file: bytes) -> Order:
    said = json.loads(header)
    if said["what"] == PictureOrder.__name__:
        return PictureOrder(file)
    correct = said["correct"]
    return SurveyOrder(
        file, said["format"], said["frame"], said["elevation_m"], said["session"],
        None if correct is None else SensorModel(*(np.asarray(each, dtype=np.float64) for each in correct)),
    )  # fmt: skip


def answer_to_bytes(answer: Walk | Picture) -> bytes:
    if isinstance(answer, Picture):
        size = {"width_px": answer.width_px, "height_px": answer.height_px, "sent_px": list(answer.sent_px)}
        header = {"kind": "picture", "media_type": answer.media_type, **size}
        return pack(header, {"encoded": np.frombuffer(answer.encoded, np.uint8)})
    samples, reckoned = answer.samples, answer.dead_reckoning
    arrays = {name: getattr(samples, name) for name in (*_SAMPLES, "B_uT")}
    if reckoned is not None:
        arrays |= {name: getattr(reckoned, name) for name in (*_RECKONING, *_HEADING, *_STEPS)}
    header = {
        "kind": "walk", "frame": samples.frame, "session": samples.session,
        "report": json.dumps(answer.report),  # as text, which keeps its order
        "bias_sd_uT": None if reckoned is None else reckoned.bias_sd_uT,
    }  # fmt: skip
    return pack(header, {name: array for name, array in arrays.items() if array is not None})


def refusal_to_bytes(error: IsodynError) -> bytes:
    kind = next(each.__name__ for each in type(error).__mro__ if each.__name__ in _REFUSALS)
    faults = [[fault.location, fault.reason] for fault in error.faults]
    return pack({"kind": "refusal", "error": kind, "message": str(error), "faults": faults}, {})


def failure_to_bytes(trace: str) -> bytes:
    return pack({"kind": "failure", "trace": trace}, {})


def told(data: bytes, order: Order) -> Walk | Picture:
    """The answer to an order. Raises what the file was refused with, and CorruptArtefact for one that cannot be."""
    try:
        header, arrays = unpack(data, _kind(data))
        if header["kind"] == "refusal":
            raise _refusal(header)
        if header["kind"] == "failure":
            raise CorruptArtefact(f"it failed:\n{header['trace'][-MAX_SENTENCE:]}")
        return _picture(header, arrays) if isinstance(order, PictureOrder) else _walk(header, arrays)
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise CorruptArtefact(f"an impossible answer: {type(error).__name__}: {error}") from error


def _kind(data: bytes) -> str:
    length = int.from_bytes(data[:8], "little")
    return str(json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["isodyn"])["kind"])


def _refusal(header: dict[str, Any]) -> IsodynError:
    faults = [Fault(str(where)[:MAX_SENTENCE], str(why)[:MAX_SENTENCE]) for where, why in header["faults"]]
    return _REFUSALS[header["error"]](str(header["message"])[:MAX_SENTENCE], *faults[:MAX_FAULTS])


def _picture(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Picture:
    _check(header["kind"] == "picture" and arrays["encoded"].dtype == np.uint8, "no picture")
    encoded, media_type = arrays["encoded"].tobytes(), header["media_type"]
    starts = {"image/png": b"\x89PNG\r\n\x1a\n", "image/webp": b"RIFF"}
    _check(encoded.startswith(starts[media_type]), "not the picture it says")
    (width, height), (sent_width, sent_height) = (header["width_px"], header["height_px"]), header["sent_px"]
    _check(all(type(side) is int and side >= 1 for side in (width, height, sent_width, sent_height)), "no size")
    _check(max(width, height) <= LONGEST_SIDE_PX and sent_width * sent_height <= MAX_PIXELS, "too large")
    return Picture(encoded, media_type, width, height, (sent_width, sent_height))


def _walk(header: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Walk:
    _check(header["kind"] == "walk" and header["frame"] in get_args(SampleFrame), "no walk")
    count = len(arrays["t_s"])
    _check(2 <= count <= MAX_SAMPLES, f"{count} samples")
    widths = {**_SAMPLES, "B_uT": 1 if header["frame"] == "norm" else 3}
    if "q_body_to_building" not in arrays:
        del widths["q_body_to_building"]
    samples = {name: _column(arrays.pop(name), count, width) for name, width in widths.items()}
    _check(bool(np.all(np.diff(samples["t_s"]) > 0)), "time does not increase")
    _check(len(header["report"]) <= MAX_REPORT_BYTES, "a long report")
    report, session = json.loads(header["report"]), header["session"]
    _check(isinstance(report, dict) and (session is None or isinstance(session, str)), "no report")
    _check(all(isinstance(each, str) for each in report["warnings"]), "no warnings")
    reckoned = None if not arrays else _reckoned(arrays, count, float(header["bias_sd_uT"]))
    return Walk(Samples(frame=header["frame"], session=session, **samples), report, reckoned)


def _reckoned(arrays: dict[str, NDArray[Any]], count: int, bias_sd_uT: float) -> DeadReckoning:
    columns = {name: _column(arrays.pop(name), count, width) for name, width in _RECKONING.items()}
    heading, heading_sd = (_column(arrays.pop(name), count, 0) if name in arrays else None for name in _HEADING)
    steps = {name: _column(arrays.pop(name), None, 0) for name in _STEPS}
    _check(len(steps["step_t_s"]) == len(steps["step_length_m"]) and not arrays, "no dead reckoning")
    return DeadReckoning(
        **columns, **steps, heading_rad=heading, heading_sd_rad=heading_sd, bias_sd_uT=bias_sd_uT
    )  # fmt: skip


def _column(array: NDArray[Any], count: int | None, width: int) -> NDArray[np.float64]:
    """An array of `count` rows (None: of any number) of `width` numbers, 0: of plain numbers, all finite."""
    shape = (len(array) if count is None else count, *((width,) if width else ()))
    _check(array.dtype == np.float64 and array.shape == shape, f"an array {array.dtype}{array.shape}, not {shape}")
    _check(bool(np.isfinite(array).all()), "numbers that are not finite")
    return array


def _check(holds: bool, what: str) -> None:
    if not holds:
        raise ValueError(what)
