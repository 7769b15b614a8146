"""Puts the jobs of a dead worker back on their queue, as the engine does when a worker starts again.

A process of its own, because an engine has one executor id for its life and this one needs the dead worker's.
"""

import json
import signal
import subprocess
import sys
import time

from dbos import DBOS
from sqlalchemy import make_url

from app.jobs.engine import engine_configuration
from app.settings import Settings
from app.telemetry.logs import configure_logs

__all__ = ["hand_over"]

TIMEOUT_S = 60.0


def hand_over(database_url: str, dead_id: str) -> None:
    """Run a janitor under the dead worker's id. Raises subprocess.SubprocessError when it could not finish."""
    order = json.dumps({"database_url": database_url, "dead_id": dead_id})  # not in the arguments: it holds a password
    subprocess.run(
        [sys.executable, "-m", "workers.janitor"],
        input=order,
        text=True,
        check=True,
        timeout=TIMEOUT_S,
        start_new_session=True,
    )


def main() -> None:
    settings = Settings()
    configure_logs(settings.log_format, settings.log_level)
    signal.alarm(int(TIMEOUT_S))  # also where whoever started it is dead, and the database away
    order = json.loads(sys.stdin.read())
    DBOS(config=engine_configuration(make_url(order["database_url"]), order["dead_id"]))
    DBOS.listen_queues([])
    DBOS.launch()
    deadline = time.monotonic() + TIMEOUT_S
    while DBOS.list_workflows(status="PENDING", executor_id=order["dead_id"], load_input=False, load_output=False):
        if time.monotonic() > deadline:
            sys.exit(f"jobs of {order['dead_id']} are still pending after {TIMEOUT_S:.0f} s")
        time.sleep(0.05)
    DBOS.destroy()


if __name__ == "__main__":
    main()
