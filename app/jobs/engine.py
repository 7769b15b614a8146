"""The names and the configuration of the job engine, DBOS (docs/decisions/0003).

The names are constants and never change meaning: rows written by older versions of Isodyn carry them.
"""

import logging

from dbos import DBOSClient, DBOSConfig, DBOSPortableJSONSerializer
from sqlalchemy import Engine, event
from sqlalchemy.engine import URL

from app.db.engine import let_go_of_the_dead, teach_old_sqlite

__all__ = ["APPLICATION", "APPLICATION_VERSION", "QUEUE", "engine_configuration", "open_client"]

APPLICATION = "isodyn"
APPLICATION_VERSION = "jobs-1"
QUEUE = "floors"

logging.getLogger("dbos").setLevel(logging.WARNING)


def open_client(engine: Engine) -> DBOSClient:
    """A client that enqueues on `engine`'s connections; a lost database raises instead of blocking the caller."""
    teach_old_sqlite()
    return DBOSClient(
        system_database_engine=engine,
        serializer=DBOSPortableJSONSerializer(),  # the default is pickle
        application_name=APPLICATION,
        retry_connection_errors=False,
        lazy=True,
    )


def engine_configuration(url: URL, executor_id: str) -> DBOSConfig:
    """The engine's configuration in a worker or a janitor."""
    teach_old_sqlite()
    if not event.contains(Engine, "connect", let_go_of_the_dead):
        event.listen(Engine, "connect", let_go_of_the_dead)  # the engine makes engines of its own
    return DBOSConfig(
        name=APPLICATION,
        system_database_url=url.render_as_string(hide_password=False),
        application_version=APPLICATION_VERSION,
        executor_id=executor_id,
        serializer=DBOSPortableJSONSerializer(),
        run_migrations=False,
        db_engine_kwargs={"pool_pre_ping": False},  # it tries again itself where a connection has died
        use_listen_notify=False,  # nobody waits for its events, and telling of them wakes a thread every 10 ms
        notification_listener_polling_interval_sec=0.25,  # how long its end may take
        log_level="WARNING",
        enable_otlp=False,
    )
