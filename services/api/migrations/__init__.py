"""Upgrades a database to the tables of this version, one numbered step after another, and keeps the stored data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sql

from services.core.errors import PlatformError
from services.pipeline.database import writing

FIRST = "0001"
"""Revision of the tables in databases that record no revision."""


def upgrade(engine: sql.Engine, to: str = "head") -> None:
    """Take all missing steps up to revision ``to``, and close the connections that were opened for that.

    Servers that start at the same time wait for each other.

    Raises:
        PlatformError: the database cannot be reached, or refuses the password.
    """
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent))
    config.set_main_option("path_separator", "os")
    with _translated_errors(engine), writing(engine) as connection:
        config.attributes["connection"] = connection
        tables = sql.inspect(connection).get_table_names()
        if "job" in tables and "alembic_version" not in tables:
            command.stamp(config, FIRST)
        command.upgrade(config, to)
    engine.dispose()


@contextmanager
def _translated_errors(engine: sql.Engine) -> Iterator[None]:
    try:
        yield
    except sql.exc.OperationalError as problem:
        if engine.dialect.name == "sqlite":
            raise
        reason = str(problem.orig).strip().splitlines()[-1].rpartition("FATAL:")[2].strip()
        remedy = (
            "check that it runs, its address, and the password, whose file DENTINE__SERVER__DATABASE_PASSWORD_FILE"
            " names"
        )
        raise PlatformError(
            f"The database at {engine.url.host} does not let this server in ({reason}); {remedy}."
        ) from problem
