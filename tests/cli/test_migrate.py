"""`isodyn migrate` waits for its database, and says so when it waits in vain."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from sqlalchemy import make_url

from app.db.engine import create_database_engine, migration_state
from tests.s3_server import Way, free_port

COMMAND = [sys.executable, "-m", "app.cli", "migrate"]


def environment(folder: Path, database_url: str) -> dict[str, str]:
    told = {name: value for name, value in os.environ.items() if name != "ISODYN_ADMIN_KEY"}
    return {**told, "ISODYN_DATA_DIR": str(folder), "ISODYN_DATABASE_URL": database_url}


@pytest.mark.postgres
def test_it_waits_for_the_database_migrates_and_makes_a_key(postgres_url: str, tmp_path: Path) -> None:
    server = make_url(postgres_url)
    way = Way(server.port or 5432)
    try:
        way.cut()
        address = server.set(host="127.0.0.1", port=way.port).render_as_string(hide_password=False)
        waiting = subprocess.Popen(
            COMMAND, env=environment(tmp_path, address), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        time.sleep(2)
        assert waiting.poll() is None
        way.mend()
        told, _ = waiting.communicate(timeout=120)
        assert waiting.returncode == 0, told
        assert "isd_" in told
    finally:
        way.close()
    engine = create_database_engine(postgres_url)
    at, head = migration_state(engine)
    engine.dispose()
    assert at == head


@pytest.mark.slow
def test_it_says_that_it_waited_in_vain(tmp_path: Path) -> None:
    nowhere = f"postgresql+psycopg://isodyn:hunter2@127.0.0.1:{free_port()}/isodyn"
    run = subprocess.run(
        [*COMMAND, "--wait", "0"], env=environment(tmp_path, nowhere), capture_output=True, text=True, check=False
    )
    assert run.returncode == 1
    assert "the database cannot be reached" in run.stderr
    assert "hunter2" not in run.stderr
    assert "Traceback" not in run.stderr
