"""`python -m workers`: one worker, with the settings of the environment."""

import argparse
import logging

from app.settings import Settings
from workers.main import run_worker


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m workers", description="Take jobs from the database and run them.")
    parser.add_argument("--exit-with-parent", action="store_true", help="end when the process that started this ends")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    run_worker(Settings(), exit_with_parent=arguments.exit_with_parent)


if __name__ == "__main__":
    main()
