"""Which data folder a database belongs to.

With another one a server would run jobs without their captures, and give receipts for files that it never had.
"""

from __future__ import annotations

import secrets
from pathlib import Path

import sqlalchemy as sql

from services.core.errors import SettingsError
from services.core.files.private import write_private
from services.core.store import write_atomic
from services.pipeline.database import metadata, parse_database_url, with_password_file, writing

FILE = "folder.id"
"""In the data folder, with a number drawn when it was first used; a copy of the folder is the folder."""

PASSWORD_FILE = "database.password"  # noqa: S105 - a name
"""In the data folder, which workers see too: the password of a database whose URL brought one along."""

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
        raise SettingsError(
            f"{what}; give a database and the folder that belong together, or write {owner} into {file} if that folder"
            " is lost for good."
        )


def keep_password_apart(url: str, data: Path) -> str:
    """The URL without its password, which is put into a private file of the data folder: the URL travels inside tasks,
    no secret does.
    """
    password = parse_database_url(url).password
    if password is None:
        return url
    write_private(data / PASSWORD_FILE, f"{password}\n".encode())
    return with_password_file(url, data / PASSWORD_FILE)
