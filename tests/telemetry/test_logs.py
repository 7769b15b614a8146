"""What the lines of real processes look like."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SPEAK = """
import logging, threading, warnings
from concurrent.futures import wait
from opentelemetry.context import attach
from app.telemetry.facts import ContextExecutor, add_facts, with_facts
from app.telemetry.logs import configure_logs
from app.telemetry.tracing import traced_from
import sys
configure_logs(sys.argv[1], sys.argv[2])
log = logging.getLogger("app.speaker")
attach(traced_from("00-" + "ab" * 16 + "-" + "cd" * 8 + "-01"))
add_facts(request_id="asked")
log.info("plain", extra={"status": 200, "key_id": None})
with ContextExecutor(1) as pool:
    wait([pool.submit(log.warning, "in a pool")])
    with with_facts(request_id="other", job_id="j", floor_id=None):
        wait([pool.submit(log.error, "in a job")])
log.debug("detail")
logging.getLogger("library").info("chatter")
logging.getLogger("dbos").warning("from the job engine")
try:
    1 / 0
except ZeroDivisionError:
    log.exception("failed")
thread = threading.Thread(target=lambda: 1 / 0, name="doomed")
thread.start(); thread.join()
raise RuntimeError("the end")
"""


def spoken(format: str, level: str = "info") -> list[str]:
    run = subprocess.run([sys.executable, "-c", SPEAK, format, level], stderr=subprocess.PIPE, text=True, check=False)
    assert run.returncode == 1
    return run.stderr.splitlines()


def test_every_line_is_json_and_says_whose_it_is() -> None:
    lines = [json.loads(line) for line in spoken("json")]
    said = {line["message"]: line for line in lines}
    assert [line["message"] for line in lines] == [
        "plain", "in a pool", "in a job", "from the job engine", "failed", "thread doomed ends by an error",
        "the process ends by an error",
    ]  # fmt: skip
    assert said["plain"]["level"] == "INFO"
    assert said["plain"]["logger"] == "app.speaker"
    assert said["plain"]["status"] == 200
    assert all(line["trace_id"] == "ab" * 16 for line in lines if "thread" not in line["message"])
    assert said["plain"]["request_id"] == said["in a pool"]["request_id"] == said["failed"]["request_id"] == "asked"
    assert (said["in a job"]["request_id"], said["in a job"]["job_id"]) == ("other", "j")
    assert "floor_id" not in said["in a job"]
    assert "ZeroDivisionError" in said["failed"]["exc_info"]
    assert "RuntimeError: the end" in said["the process ends by an error"]["exc_info"]


def test_text_is_for_people() -> None:
    line = spoken("text")[0]
    assert re.fullmatch(
        r"\d{4}(-\d\d){2}T\d\d(:\d\d){2}\.\d{3}Z INFO app\.speaker: "
        r"plain status=200 request_id=asked trace_id=(ab){16}",
        line,
    )


@pytest.mark.parametrize(("level", "plain", "detail"), [("debug", True, True), ("warning", False, False)])
def test_the_level_is_ours_not_the_libraries(level: str, plain: bool, detail: bool) -> None:
    said = [json.loads(line)["message"] for line in spoken("json", level)]
    assert ("plain" in said, "detail" in said) == (plain, detail)
    assert "chatter" not in said


def test_a_command_reads_its_log_from_the_environment(tmp_path: Path) -> None:
    environment = {**os.environ, "ISODYN_DATA_DIR": str(tmp_path), "ISODYN_LOG_LEVEL": "loud"}
    run = subprocess.run(
        [sys.executable, "-m", "app.cli", "migrate"], env=environment, capture_output=True, text=True, check=False
    )
    assert run.returncode == 2
    assert "ISODYN_LOG_LEVEL" in run.stderr
