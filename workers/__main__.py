"""`python -m workers`: one worker, with the settings of the environment."""

import argparse
import logging
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
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s")

    from app.settings import Settings
    from workers.main import run_worker

    run_worker(Settings(), parent_pid=arguments.exit_with_parent)


if __name__ == "__main__":
    main()
