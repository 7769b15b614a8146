"""Settings and refusals as a person at a terminal sees them: a sentence, never a traceback."""

from collections.abc import Iterator
from contextlib import contextmanager

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape

from app.errors import IsodynError
from app.settings import Settings
from app.telemetry.logs import configure_logs

__all__ = ["read_settings", "say_refusals"]


def read_settings() -> Settings:
    """The settings of the environment, and the log as they want it; or one line per wrong variable, and the end."""
    try:
        settings = Settings()
        configure_logs(settings.log_format, settings.log_level)
        return settings
    except ValidationError as error:
        for fault in error.errors():
            _complain(f"ISODYN_{str(fault['loc'][0]).upper()}={fault['input']}: {fault['msg']}")
        raise typer.Exit(2) from error


@contextmanager
def say_refusals() -> Iterator[None]:
    """End the command with the error's own sentence."""
    try:
        yield
    except IsodynError as error:
        _complain(str(error))
        raise typer.Exit(2) from error


def _complain(sentence: str) -> None:
    Console(stderr=True, highlight=False).print(f"[red]{escape(sentence)}[/red]", soft_wrap=True)
