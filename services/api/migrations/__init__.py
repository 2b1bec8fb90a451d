"""Brings a database to the tables of this version, one numbered step after another; what is stored is kept."""

from __future__ import annotations

from pathlib import Path

import sqlalchemy as sql

from services.api.database import writing

FIRST = "0001"
"""The tables that databases had before they were numbered."""


def upgrade(engine: sql.Engine, to: str = "head") -> None:
    """Take all steps that are missing, up to one, and close what was opened for that. Servers that start together wait for each other."""
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent))
    config.set_main_option("path_separator", "os")
    with writing(engine) as connection:
        config.attributes["connection"] = connection
        tables = sql.inspect(connection).get_table_names()
        if "job" in tables and "alembic_version" not in tables:
            command.stamp(config, FIRST)
        command.upgrade(config, to)
    engine.dispose()
