"""Walks of a folder of floors: read, held out by turns, and freed of the hard iron of their calibration session."""

import gzip
import zlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from app.errors import Fault, InvalidInput, UnreadableSurvey
from app.field.body_bias import BodyBias
from app.field.samples import Samples
from app.field.session_bias import remove_session_biases, unmet_session
from app.geometry import rotate_by_quaternion
from app.survey.read import read_survey
from app.survey.walk import DeadReckoning, Walk

__all__ = [
    "HELD_OUT_EVERY", "WALK_SUFFIXES", "Told", "calibrate_sessions", "collected", "hold_out", "on_one_thread",
    "read_floors", "session_of",
]  # fmt: skip

HELD_OUT_EVERY = 5
WALK_SUFFIXES = (".txt", ".txt.gz")
MAX_WALK_BYTES = 64 * 2**20

Told = Callable[[str, int, int], None]  # (stage, done, total)


def hold_out(walks: Mapping[str, object], fold: int = HELD_OUT_EVERY - 1) -> tuple[list[str], list[str]]:
    """(names to map, names held out): every fifth in order of name is held out, from the fifth or another on."""
    names = sorted(walks)
    held_out = names[fold::HELD_OUT_EVERY]
    return [name for name in names if name not in set(held_out)], held_out


def calibrate_sessions(walks: Mapping[str, Walk], biases: Mapping[str, BodyBias]) -> dict[str, Walk]:
    """The walks of a floor without the offset of their calibration session."""
    samples = remove_session_biases({name: walk.samples for name, walk in walks.items()}, biases)
    return {
        name: replace(walk, samples=samples[name], dead_reckoning=_calibrated(walk, biases))
        for name, walk in walks.items()
    }


def _calibrated(walk: Walk, biases: Mapping[str, BodyBias]) -> DeadReckoning | None:
    reckoned, bias = walk.dead_reckoning, biases.get(str(walk.samples.session))
    if reckoned is None or bias is None:
        return reckoned
    offset_uT = np.broadcast_to(bias.bias_body_uT, reckoned.B_level_uT.shape)
    return replace(reckoned, B_level_uT=reckoned.B_level_uT - rotate_by_quaternion(reckoned.q_body_to_level, offset_uT))


def read_floors(directory: Path, told: Told) -> tuple[dict[str, dict[str, Walk]], dict[str, str]]:
    """Floor -> name -> walk, and what could not be read and why. Raises InvalidInput when there is nothing."""
    files = [
        (folder.name, file)
        for folder in sorted(path for path in directory.iterdir() if path.is_dir())
        for file in sorted(folder.iterdir())
        if file.name.endswith(WALK_SUFFIXES)
    ]
    floors: dict[str, dict[str, Walk]] = {}
    unreadable: dict[str, str] = {}
    for done, (floor_id, file) in enumerate(files, start=1):
        try:
            floors.setdefault(floor_id, {})[file.name.split(".")[0]] = read_survey(
                _walk_bytes(file), format="indoor-location-2020"
            )
        except UnreadableSurvey as error:
            unreadable[f"{floor_id}/{file.name}"] = str(error)
        told("reading walks", done, len(files))
    floors = {floor_id: walks for floor_id, walks in floors.items() if len(walks) >= HELD_OUT_EVERY}
    if not floors:
        raise InvalidInput(
            f"{directory} holds no floor to evaluate; give a folder with one folder per floor, each with at least "
            f"{HELD_OUT_EVERY} readable walks (*.txt or *.txt.gz) of format indoor-location-2020",
            *(Fault(name, reason) for name, reason in unreadable.items()),
        )
    return floors, unreadable


def _walk_bytes(file: Path) -> bytes:
    """The bytes of a walk, unpacked if need be. Raises UnreadableSurvey for a damaged or oversize archive."""
    if not file.name.endswith(".gz"):
        return file.read_bytes()
    try:
        with gzip.open(file) as stream:
            data = stream.read(MAX_WALK_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise UnreadableSurvey(f"the archive is damaged: {error}", Fault("file", str(error))) from error
    if len(data) > MAX_WALK_BYTES:
        raise UnreadableSurvey(f"the archive unpacks to more than {MAX_WALK_BYTES:,} bytes", Fault("file", "too large"))
    return data


def session_of(samples: Samples, biases: Mapping[str, BodyBias] | None) -> BodyBias | None:
    """What is known of the walk's session; None where nothing was taken out of any."""
    if biases is None or samples.session is None or samples.q_body_to_building is None:
        return None
    return biases.get(samples.session) or unmet_session(samples)


def collected(futures: Mapping[Future[Any], Any], told: Told, stage: str) -> Iterator[tuple[Any, Any]]:
    """(key, result) of every future, as they come."""
    told(stage, 0, len(futures))
    for done, future in enumerate(as_completed(futures), start=1):
        yield futures[future], future.result()
        told(stage, done, len(futures))


def on_one_thread() -> None:
    """BLAS, in a child process."""
    threadpool_limits(1)
