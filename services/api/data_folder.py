"""Which data folder a database belongs to. With another one a server would run jobs without their captures, and give receipts for files that it never had."""

from __future__ import annotations

import secrets
from pathlib import Path

import sqlalchemy as sql

from services.api.database import metadata, writing
from services.core.errors import SettingsError
from services.core.store import write_atomic

FILE = "folder.id"
"""In the data folder, with a number drawn when it was first used; a copy of the folder is the folder."""

data_folder_table = sql.Table("data_folder", metadata, sql.Column("id", sql.Text, primary_key=True))


def require_own_folder(engine: sql.Engine, data: Path) -> None:
    """Refuse, and close, a database of another data folder; one that belongs to none becomes this one's.

    Raises:
        SettingsError: it belongs to another folder.
    """
    file = data / FILE
    if not file.exists():
        write_atomic(file, f"{secrets.token_hex(8)}\n".encode())
    own = file.read_text().strip()
    with writing(engine) as connection:
        owner = connection.scalar(sql.select(data_folder_table.c.id))
        if owner is None:
            connection.execute(data_folder_table.insert().values(id=own))
    if owner not in {None, own}:
        engine.dispose()
        what = f"The database belongs to another data folder than {data}, which has none of its jobs' files"
        raise SettingsError(f"{what}; give a database and the folder that belong together, or write {owner} into {file} if that folder is lost for good.")
