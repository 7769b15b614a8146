"""Alembic's entry: runs on the connection `app.db.engine` hands over, or on ISODYN_DATABASE_URL from the shell."""

from typing import Any

from alembic import context
from sqlalchemy import Connection

from app.db.engine import create_database_engine
from app.db.tables import Base, UtcDateTime
from app.settings import Settings


def ours(_item: object, _name: str | None, kind: str, reflected: bool, compared_to: object) -> bool:
    """Whether autogenerate looks at this: on SQLite the job engine's tables lie beside ours."""
    return not (kind == "table" and reflected and compared_to is None)


def render(kind: str, item: Any, _context: object) -> str | bool:
    """Write our own types as what they are in the database: a migration must not change with the code."""
    return "sa.DateTime(timezone=True)" if kind == "type" and isinstance(item, UtcDateTime) else False


def run(connection: Connection) -> None:
    context.configure(
        connection=connection,
        target_metadata=Base.metadata,
        include_object=ours,
        render_item=render,
        render_as_batch=True,  # SQLite alters a table by copying it
        transactional_ddl=True,
    )
    with context.begin_transaction():
        context.run_migrations()


given: Any = context.config.attributes.get("connection")
if given is not None:
    run(given)
else:
    engine = create_database_engine(Settings().resolved_database_url)
    with engine.connect() as opened:
        run(opened)
        opened.commit()
    engine.dispose()
