"""A group of commands with a default: what is no command's name is the default command's first argument."""

from typing import Any

from typer.core import TyperGroup

__all__ = ["DEFAULT", "DefaultGroup"]

DEFAULT = "(default)"
"""The name of the default command within its group; nobody has to type it."""


class DefaultGroup(TyperGroup):
    """`group command ...` where there is such a command, else the default one: `group ...`, help and faults included.

    A folder named as a command is reached as `./command`.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or args[0] not in self.commands:
            args = [DEFAULT, *args]
        return super().parse_args(ctx, args)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        return "" if name == DEFAULT else name, command, rest
