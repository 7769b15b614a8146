"""`python -m workers`: one worker, with the settings of the environment."""

import argparse
import os

PARENT_PID = os.getppid()  # before anything slow is imported: the parent may die meanwhile


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m workers", description="Take jobs from the database and run them.")
    parser.add_argument(
        "--exit-with-parent",
        type=int,
        nargs="?",
        const=PARENT_PID,
        metavar="PID",
        help="end when the process that started this, PID if given, ends",
    )
    arguments = parser.parse_args()

    from app.settings import Settings
    from app.telemetry.logs import configure_logs
    from app.telemetry.tracing import configure_tracing
    from workers.main import run_worker

    settings = Settings()
    configure_logs(settings.log_format, settings.log_level)
    configure_tracing(settings.otel, "isodyn-worker")
    run_worker(settings, parent_pid=arguments.exit_with_parent)


if __name__ == "__main__":
    main()
