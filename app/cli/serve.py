"""`isodyn serve`, `isodyn worker` and `isodyn openapi`."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

__all__ = ["openapi", "serve", "worker"]

RESTART_AFTER_S = 1.0


def serve(
    host: Annotated[str | None, typer.Option(help="address to listen on [ISODYN_HOST, 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="port to listen on [ISODYN_PORT, 8300]")] = None,
    embedded_worker: Annotated[bool, typer.Option("--worker/--no-worker", help="fit maps in a child process")] = True,
) -> None:
    """Run the API, the page and an embedded worker."""
    import uvicorn

    from app.main import create_app, first_start
    from app.settings import Settings

    settings = Settings()
    settings = settings.model_copy(update={"host": host or settings.host, "port": port or settings.port})
    made = first_start(settings)
    console = Console(stderr=True, highlight=False)
    if made is not None:
        console.print(f"[bold]Admin key (shown this once, keep it):[/bold] {made}", soft_wrap=True)
    # uvicorn stops gracefully on SIGTERM and then raises it again: let that end here, past the worker's farewell.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    supervisor = WorkerSupervisor() if embedded_worker else None
    if supervisor is not None:
        supervisor.start()
    try:
        console.print(f"Isodyn listens on http://{settings.host}:{settings.port} (page: /view/, contract: /docs)")
        uvicorn.run(create_app(settings), host=settings.host, port=settings.port, log_level="warning",
                    timeout_graceful_shutdown=10)  # fmt: skip
    finally:
        if supervisor is not None:
            supervisor.stop()


def worker() -> None:
    """Run one worker: it takes jobs from the database until it is stopped."""
    from app.main import first_start
    from app.settings import Settings
    from workers.main import run_worker

    settings = Settings()
    first_start(settings)
    run_worker(settings)


def openapi(
    output: Annotated[Path | None, typer.Option(help="file to write; default: standard output")] = None,
) -> None:
    """Write the OpenAPI document."""
    import tempfile

    from app.main import create_app, first_start
    from app.settings import Settings

    with tempfile.TemporaryDirectory() as folder:
        settings = Settings(data_dir=Path(folder), database_url=None, blob_url=None)
        first_start(settings)
        document = json.dumps(create_app(settings).openapi(), indent=2)
    if output is None:
        print(document)
    else:
        output.write_text(document + "\n")


class WorkerSupervisor:
    """Keeps one worker process alive beside the server: starts it, restarts it when it dies, stops it at the end."""

    def __init__(self) -> None:
        self._stopping = threading.Event()
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._watch, name="worker-supervisor", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Ask the worker to finish, and make sure that it is gone."""
        self._stopping.set()
        with self._lock:
            process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                process.kill()
        self._thread.join(timeout=5)

    def _watch(self) -> None:
        while not self._stopping.is_set():
            with self._lock:
                # A session of its own: Ctrl-C in the terminal is the server's to hear, and it then asks the worker.
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "workers", "--exit-with-parent", str(os.getpid())], start_new_session=True
                )
            self._process.wait()
            self._stopping.wait(RESTART_AFTER_S)
