"""Foreign files in processes of their own: the same answers as here, and nothing a file does reaches this process."""

import io
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from pyarrow import parquet

from app.calibration.sensor_model import SensorModel
from app.errors import CorruptArtefact, InvalidInput, IsodynError, TooLarge, Unavailable, UnreadableSurvey
from app.services.artefacts import pack, samples_to_bytes
from app.services.file_messages import answer_to_bytes, told
from app.services.file_orders import PictureOrder, SurveyOrder, carry_out
from app.services.file_readers import FileReaders, _Program
from app.services.receive_plan import Picture
from app.survey.walk import Walk
from tests.survey.conftest import as_csv, as_ndjson, as_parquet, make_walk

GIB = 2**30
COLUMNS = ("t_s", "x_m", "y_m", "z_m", "bx_ut", "by_ut", "bz_ut", "qw", "qx", "qy", "qz")
WRITERS: dict[str, Callable[[Any], bytes]] = {"csv": as_csv, "ndjson": as_ndjson, "parquet": as_parquet}
MODEL = SensorModel(np.array([1.0, -2.0, 0.5]), np.eye(3) + 0.01)


def columns(n: int = 40, seed: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    values = [np.arange(n) / 10.0, *rng.uniform(0, 9, (3, n)), *rng.uniform(15, 35, (3, n)), *q.T]
    return dict(zip(COLUMNS, values, strict=True))


def picture(format: str = "PNG", size: tuple[int, int] = (50, 30)) -> bytes:
    out = io.BytesIO()
    Image.effect_noise(size, 60.0).convert("RGB").save(out, format)
    return out.getvalue()


TRACE = make_walk(corners=((0, 0), (6, 0), (6, 4))).data
FILES = {**{format: write(columns()) for format, write in WRITERS.items()}, "indoor-location-2020": TRACE}


def outcome(read: Callable[[], Walk | Picture]) -> Any:
    """All that an answer says, in a form that shows every bit."""
    try:
        answer = read()
    except IsodynError as error:
        return type(error), str(error), error.faults
    if isinstance(answer, Picture):
        return answer
    reckoned = answer.dead_reckoning
    names = () if reckoned is None else reckoned.__slots__
    inner = [None if (x := getattr(reckoned, name)) is None else np.asarray(x).tobytes() for name in names]
    return samples_to_bytes(answer.samples), json.dumps(answer.report), inner


@pytest.fixture(scope="module")
def readers() -> Iterator[FileReaders]:
    made = FileReaders(2, 2 * GIB, 60.0)
    yield made
    made.close()


def same(readers: FileReaders, order: SurveyOrder | PictureOrder) -> bool:
    here = outcome(lambda: carry_out(order))
    if isinstance(order, PictureOrder):
        return bool(outcome(lambda: readers.picture(order.data)) == here)
    return bool(outcome(lambda: readers.survey(order)) == here)


@pytest.mark.parametrize("format", FILES)
@pytest.mark.parametrize(("frame", "correct"), [("building", None), ("norm", None), ("building", MODEL)])
def test_a_survey_reads_as_it_does_here(readers: FileReaders, format: str, frame: Any, correct: Any) -> None:
    session = "robot-7" if format != "indoor-location-2020" else None
    assert same(readers, SurveyOrder(FILES[format], format, frame, 4.5, session, correct))


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    format=st.sampled_from(sorted(FILES)),
    edits=st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=4)), max_size=3),
    cut=st.floats(0, 1),
)
def test_a_damaged_survey_is_refused_as_it_is_here(
    readers: FileReaders, format: str, edits: list[tuple[float, bytes]], cut: float
) -> None:
    data = bytearray(FILES[format])
    for place, change in edits:
        at = int(place * (len(data) - 1))
        data[at : at + len(change)] = change
    if cut < 0.3:
        del data[int(cut / 0.3 * len(data)) :]
    assert same(readers, SurveyOrder(bytes(data), format, "building", 0.0))


@pytest.mark.parametrize("data", [picture(), picture("JPEG", (6000, 20)), picture("WEBP"), picture()[:200], b"GIF89a"])
def test_a_picture_is_drawn_as_it_is_here(readers: FileReaders, data: bytes) -> None:
    assert same(readers, PictureOrder(data))


def large_parquet(n: int = 900_000) -> bytes:
    """A few kilobytes that unpack to tens of megabytes."""
    flat = {name: np.zeros(n) for name in COLUMNS[1:]}
    out = io.BytesIO()
    parquet.write_table(pa.table({"t_s": np.arange(n) * 0.5, **flat}), out, compression="zstd")
    return out.getvalue()


def test_a_file_that_takes_too_much_memory_is_refused_and_the_next_is_read() -> None:
    small = FileReaders(1, 24 * 2**20, 60.0)
    try:
        with pytest.raises(UnreadableSurvey, match=r"memory|ended the process|malloc"):
            small.survey(SurveyOrder(large_parquet(), "parquet", "building", 0.0))
        with pytest.raises(UnreadableSurvey, match="24 MiB of memory"):
            small.survey(SurveyOrder(as_ndjson(columns(100_000)), "ndjson", "building", 0.0))
        assert len(small.survey(SurveyOrder(FILES["csv"], "csv", "building", 0.0)).samples) == 40
    finally:
        small.close()


def children_of(pid: int) -> list[int]:
    return [int(child) for task in Path(f"/proc/{pid}/task").iterdir()
            for child in (task / "children").read_text().split()]  # fmt: skip


def until(true: Callable[[], Any], patience_s: float = 30.0) -> Any:
    """What `true` says once it says something."""
    give_up = time.monotonic() + patience_s
    while not (said := true()):
        assert time.monotonic() < give_up
        time.sleep(0.01)
    return said


def programs() -> list[int]:
    """Those that this process has running."""
    return [pid for pid in children_of(os.getpid()) if b"file_process" in command(pid)]


def test_a_file_that_takes_too_long_is_refused_and_the_next_is_read() -> None:
    there, hasty = programs(), FileReaders(1, 2 * GIB, 3.0)
    hasty.start()
    (program,) = set(programs()) - set(there)
    try:
        with ThreadPoolExecutor(1) as threads:
            reading = threads.submit(hasty.survey, SurveyOrder(as_ndjson(columns(50_000)), "ndjson", "building", 0.0))
            os.kill(until(lambda: children_of(program))[0], signal.SIGSTOP)
            with pytest.raises(UnreadableSurvey, match="longer than 3 s"):
                reading.result()
        assert len(hasty.survey(SurveyOrder(FILES["csv"], "csv", "building", 0.0)).samples) == 40
    finally:
        hasty.close()


def test_a_reader_that_dies_takes_only_its_file_with_it(readers: FileReaders) -> None:
    """A crash is the file's fault; what the kernel kills for lack of memory is not."""
    readers.start()
    (program,) = programs()
    slow, quick = as_ndjson(columns(50_000)), SurveyOrder(FILES["csv"], "csv", "building", 0.0)
    with ThreadPoolExecutor(2) as threads:
        for ended_by, refused, why in (
            (signal.SIGSEGV, UnreadableSurvey, "ended the process that read it"),
            (signal.SIGKILL, Unavailable, "for lack of memory perhaps; send it again"),
        ):
            reading = threads.submit(readers.survey, SurveyOrder(slow, "ndjson", "building", 0.0))
            os.kill(until(lambda: children_of(program))[0], ended_by)
            assert len(readers.survey(quick).samples) == 40
            with pytest.raises(refused, match=why):
                reading.result()
            until(lambda: not children_of(program))
        os.kill(program, signal.SIGKILL)
        assert len(threads.submit(readers.survey, quick).result().samples) == 40, "the program is started again"


@pytest.mark.slow
def test_where_no_process_can_be_started_no_file_is_to_blame(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """An operating system that has no more of them, while a file is being read."""
    full, there = tmp_path / "full", programs()
    (tmp_path / "sitecustomize.py").write_text(
        "import errno, os\nfork = os.fork\n"
        "def of_a_full_system():\n"
        f"    if os.path.exists({str(full)!r}):\n"
        "        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))\n"
        "    return fork()\n"
        "os.fork = of_a_full_system\n"
    )
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path.cwd()}")
    made, quick = FileReaders(2, 2 * GIB, 60.0), SurveyOrder(FILES["csv"], "csv", "building", 0.0)
    try:
        with monkeypatch.context() as no_python:
            no_python.setattr(sys, "executable", str(tmp_path / "nowhere"))
            with pytest.raises(Unavailable, match="cannot be started now"):
                made.start()
        made.start()
        (program,) = set(programs()) - set(there)
        with ThreadPoolExecutor(1) as threads:
            slow = SurveyOrder(as_ndjson(columns(20_000)), "ndjson", "building", 0.0)
            reading = threads.submit(made.survey, slow)
            until(lambda: children_of(program))
            full.touch()
            with pytest.raises(Unavailable, match="Resource temporarily unavailable; send it again"):
                made.survey(quick)
            full.unlink()
            assert len(made.survey(quick).samples) == 40
            assert len(reading.result().samples) == 20_000, "it read on"
        assert set(programs()) - set(there) == {program}
    finally:
        made.close()


@pytest.mark.slow
def test_an_answer_that_comes_too_late_is_taken_for_no_other() -> None:
    program = _Program()
    try:
        pid = program._process.pid
        ours, theirs = socket.socketpair()
        with ours, theirs:
            child = program.fork(theirs, 10, GIB)
            program._control.settimeout(0.1)
            os.kill(pid, signal.SIGSTOP)
            assert program.end(child) == -signal.SIGKILL, "nobody knows how it ended"
            os.kill(pid, signal.SIGCONT)
            until(lambda: not command(child))
            with pytest.raises(OSError, match="descriptor"):
                program.fork(theirs, 10, GIB)
    finally:
        program.close()


def command(pid: int) -> bytes:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    except FileNotFoundError:
        return b""


def limits_of(pid: int) -> dict[str, list[str]]:
    lines = Path(f"/proc/{pid}/limits").read_text().splitlines()
    return {line[:26].strip(): line[26:].split() for line in lines}


def test_no_process_is_left_when_the_server_dies_and_none_knows_its_secrets() -> None:
    """Killed in the middle of a file."""
    program = (
        "import sys\nfrom app.services.file_orders import SurveyOrder\n"
        "from app.services.file_readers import FileReaders\n"
        "readers = FileReaders(1, 2**31, 60.0)\nreaders.start()\nprint('ready', flush=True)\n"
        "readers.survey(SurveyOrder(sys.stdin.buffer.read(), 'ndjson', 'building', 0.0))\n"
    )
    secrets = {"ISODYN_ADMIN_KEY": "isd_hidden", "AWS_SECRET_ACCESS_KEY": "hidden", "ISODYN_DATABASE_URL": "hidden"}
    server = subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env={**os.environ, **secrets}
    )
    assert server.stdin is not None
    assert server.stdout is not None
    with server, server.stdin, server.stdout:
        assert server.stdout.readline() == b"ready\n"
        (reader,) = children_of(server.pid)
        assert b"hidden" not in Path(f"/proc/{reader}/environ").read_bytes()
        server.stdin.write(as_ndjson(columns(50_000)))
        server.stdin.close()
        (child,) = until(lambda: children_of(reader))
        until(lambda: limits_of(child)["Max open files"][:2] == ["0", "0"])
        assert limits_of(child)["Max file size"][:2] == ["0", "0"]
        server.kill()
    until(lambda: not command(reader) and not command(child))


def forged(header: dict[str, Any], **arrays: np.ndarray) -> bytes:
    return pack(header, arrays)


def walk_header(**changes: Any) -> dict[str, Any]:
    header = {"kind": "walk", "frame": "building", "session": None, "report": '{"warnings": []}', "bias_sd_uT": None}
    return header | changes


T, P, B = np.arange(3.0), np.zeros((3, 3)), np.full((3, 3), 20.0)


@pytest.mark.parametrize(
    "lie",
    [
        b"", b"\xff" * 64, pack({"kind": "grid"}, {"t_s": T}),
        forged(walk_header(), t_s=T, p_building_m=P, B_uT=B[:2]),
        forged(walk_header(), t_s=T, p_building_m=P, B_uT=B.astype(np.float32)),
        forged(walk_header(), t_s=T, p_building_m=P, B_uT=B * np.nan),
        forged(walk_header(), t_s=T[::-1].copy(), p_building_m=P, B_uT=B),
        forged(walk_header(frame="secret"), t_s=T, p_building_m=P, B_uT=B),
        forged(walk_header(report="[]"), t_s=T, p_building_m=P, B_uT=B),
        forged(walk_header(report='{"warnings": [1]}'), t_s=T, p_building_m=P, B_uT=B),
        forged(walk_header(report="{" * 100_000), t_s=T, p_building_m=P, B_uT=B),
        forged(walk_header(session=7), t_s=T, p_building_m=P, B_uT=B),
        forged(walk_header(bias_sd_uT=1.0), t_s=T, p_building_m=P, B_uT=B, os=T),
        forged({"kind": "refusal", "error": "SystemExit", "message": "x", "faults": []}),
        forged({"kind": "refusal", "error": "TooLarge", "message": "x", "faults": [1]}),
        forged({"kind": "failure", "trace": "Traceback"}),
    ],
)  # fmt: skip
def test_an_impossible_answer_is_not_believed(lie: bytes) -> None:
    with pytest.raises(CorruptArtefact):
        told(lie, SurveyOrder(b"", "csv", "building", 0.0))


@pytest.mark.parametrize(
    "change",
    [{"media_type": "text/html"}, {"width_px": 10**6}, {"sent_px": [-1, 5]}, {"sent_px": [10**9, 10**9]},
     {"width_px": "5"}, {"kind": "walk"}],
)  # fmt: skip
def test_an_impossible_picture_is_not_believed(change: dict[str, Any]) -> None:
    header = {"kind": "picture", "media_type": "image/png", "width_px": 5, "height_px": 5, "sent_px": [5, 5]}
    encoded = np.frombuffer(picture(), np.uint8)
    assert isinstance(told(forged(header, encoded=encoded), PictureOrder(b"")), Picture)
    with pytest.raises(CorruptArtefact):
        told(forged(header | change, encoded=encoded), PictureOrder(b""))


def test_a_walk_survives_its_message_bit_for_bit() -> None:
    order = SurveyOrder(TRACE, "indoor-location-2020", "building", 3.0)
    walk = carry_out(order)
    assert outcome(lambda: told(answer_to_bytes(walk), order)) == outcome(lambda: walk)


def test_a_refusal_is_told_in_full(readers: FileReaders) -> None:
    with pytest.raises(InvalidInput, match="not a PNG, JPEG or WebP picture"):
        readers.picture(b"GIF89a")
    with pytest.raises(TooLarge):
        readers.survey(SurveyOrder(b"t_s\n" * 2_000_002, "csv", "building", 0.0))
