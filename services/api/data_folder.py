"""Checks that a database and a data folder belong together.

With another data folder a server would run jobs without their captures, and give receipts for files that it never had.
"""

from __future__ import annotations

import secrets
from pathlib import Path

import sqlalchemy as sql

from services.core.errors import PlatformError, SettingsError
from services.core.files.private import write_private
from services.core.store import write_atomic
from services.pipeline.database import metadata, parse_database_url, with_password_file, writing

FILE = "folder.id"
"""Name of a file in the data folder that holds a random number, drawn when the folder was first used. A copy of the
folder has the same number and counts as the same folder."""

PASSWORD_FILE = "database.password"  # noqa: S105 - a name
"""Name of a file in the data folder, which workers can read too, with the password of a database whose URL contained
one."""

data_folder_table = sql.Table("data_folder", metadata, sql.Column("id", sql.Text, primary_key=True))


def require_own_folder(engine: sql.Engine, data: Path, *, lies_in_folder: bool = False) -> None:
    """Refuse a database of another data folder and close it. A database that belongs to no folder is assigned to this
    one.

    Args:
        lies_in_folder: the database is the one in the data folder. It belongs to that folder, also where it was copied
            there from another one.

    Raises:
        SettingsError: the database belongs to another folder.
    """
    file = data / FILE
    if not file.exists():
        write_atomic(file, f"{secrets.token_hex(8)}\n".encode())
    own = file.read_text().strip()
    with writing(engine) as connection:
        owner = connection.scalar(sql.select(data_folder_table.c.id))
        if lies_in_folder and owner not in {None, own}:
            connection.execute(data_folder_table.delete())
            owner = None
        if owner is None:
            connection.execute(data_folder_table.insert().values(id=own))
    if owner not in {None, own}:
        engine.dispose()
        what = f"The database belongs to another data folder than {data}, which has none of its jobs' files"
        raise SettingsError(
            f"{what}; give a database and the folder that belong together, or write {owner} into {file} if that folder"
            " is lost for good."
        )


class OpenedFolder:
    """The data folder that a server has opened, which may be moved or unmounted while it runs."""

    def __init__(self, data: Path) -> None:
        self._data, self._id = data, (data / FILE).read_text()

    def require_present(self) -> None:
        """Check that the folder is still where it was.

        Raises:
            PlatformError: it is absent, or another one lies there.
        """
        try:
            if (self._data / FILE).read_text() == self._id:
                return
        except OSError as problem:
            raise PlatformError(f"{self._lost} ({problem.strerror}); {_REMEDY}") from problem
        raise PlatformError(f"{self._lost}, another one lies there; {_REMEDY}")

    @property
    def _lost(self) -> str:
        return f"The data folder {self._data} is no longer the one that this server opened"


_REMEDY = "put it back or mount it again, then ask again."


def keep_password_apart(url: str, data: Path) -> str:
    """Return the URL without its password, and write the password to a private file of the data folder. The URL travels
    inside tasks, which must carry no secret.
    """
    password = parse_database_url(url).password
    if password is None:
        return url
    write_private(data / PASSWORD_FILE, f"{password}\n".encode())
    return with_password_file(url, data / PASSWORD_FILE)
