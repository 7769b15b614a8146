"""Steps of migrations that need care while others write."""

from collections.abc import Sequence

from alembic import context, op

__all__ = ["WHILE_OTHERS_WRITE", "create_index"]

WHILE_OTHERS_WRITE = "while others write"
"""Attribute of Alembic's configuration: the migrations are not part of a larger transaction."""

LONGEST_WAIT = "60s"  # for transactions older than the index; writers go on meanwhile


def create_index(name: str, table: str, columns: Sequence[str], *, unique: bool = False) -> None:
    """An index on a table that has rows; in a migration of its own, which may be tried again.

    On PostgreSQL writers go on while it is built, except inside a larger transaction (a restore), which has no others.
    """
    if op.get_context().dialect.name != "postgresql" or not context.config.attributes.get(WHILE_OTHERS_WRITE):
        op.create_index(name, table, columns, unique=unique)
        return
    with op.get_context().autocommit_block():
        op.execute(f"SET lock_timeout = '{LONGEST_WAIT}'")
        op.execute("SET statement_timeout = 0")
        op.drop_index(name, table_name=table, if_exists=True, postgresql_concurrently=True)  # a half-built one
        op.create_index(name, table, columns, unique=unique, postgresql_concurrently=True)
