"""`isodyn serve`, `isodyn worker` and `isodyn openapi`."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from math import ceil
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from app.cli.environment import read_settings, say_refusals
from app.telemetry.tracing import configure_tracing

__all__ = ["openapi", "serve", "worker"]

RESTART_AFTER_S = 1.0


def serve(
    host: Annotated[str | None, typer.Option(help="address to listen on [ISODYN_HOST, 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="port to listen on [ISODYN_PORT, 8300]")] = None,
    embedded_worker: Annotated[bool, typer.Option("--worker/--no-worker", help="fit maps in a child process")] = True,
) -> None:
    """Run the API, the page and an embedded worker."""
    import uvicorn

    from app.api.patient_http import PatientHttp
    from app.main import create_app, first_start

    settings = read_settings()
    settings = settings.model_copy(update={"host": host or settings.host, "port": port or settings.port})
    console = Console(stderr=True, highlight=False)
    _check_port(settings.host, settings.port)
    with say_refusals():
        configure_tracing(settings.otel, "isodyn-api")
        made = first_start(settings)
        app = create_app(settings)
    if made is not None:
        console.print(f"[bold]Admin key (shown this once, keep it):[/bold] {made}", soft_wrap=True)
    # uvicorn stops gracefully on SIGTERM and then raises it again: let that end here, past the worker's farewell.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    threading.Thread(target=app.state.context.files.start, name="file-readers", daemon=True).start()
    supervisor = WorkerSupervisor() if embedded_worker else None
    if supervisor is not None:
        supervisor.start()
    try:
        console.print(f"Isodyn listens on http://{settings.host}:{settings.port} (page: /view/, contract: /docs)")
        uvicorn.run(app, host=settings.host, port=settings.port, log_config=None, log_level="warning", access_log=False,
                    http=PatientHttp, server_header=False, proxy_headers=True,
                    forwarded_allow_ips=settings.trusted_proxies, timeout_graceful_shutdown=ceil(settings.shutdown_s),
                    ws_max_size=2**20, ws_ping_timeout=60)  # fmt: skip
    finally:
        if supervisor is not None:
            supervisor.stop()


def worker() -> None:
    """Run one worker: it takes jobs from the database until it is stopped."""
    from workers.main import run_worker

    settings = read_settings()
    settings.data_dir.mkdir(parents=True, exist_ok=True)
    with say_refusals():
        configure_tracing(settings.otel, "isodyn-worker")
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


def _check_port(host: str, port: int) -> None:
    """End the command if somebody listens there already."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            Console(stderr=True, highlight=False).print(
                f"[red]cannot listen on {host}:{port}: {error.strerror}[/red]; choose another with --port or --host"
            )
            raise typer.Exit(2) from error


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
