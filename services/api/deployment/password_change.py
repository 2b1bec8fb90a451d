"""Changes the password of the database while the system runs."""

from __future__ import annotations

import secrets
from pathlib import Path

import sqlalchemy as sql

from services.api.deployment.secrets import PASSWORD_BYTES, write_password
from services.core.errors import PlatformError, SettingsError
from services.core.files.private import write_private
from services.pipeline.database import open_database, parse_database_url, read_password, with_password_file


def change_database_password(url: str, file: Path) -> None:
    """Change the password in the database, then in the file.

    The new password is written beside the file first, so that it is not lost if this is interrupted between the two
    changes: the next call tries it.

    Raises:
        SettingsError: the database is not Postgres, or the file is absent. PlatformError: the database refuses both
            passwords.
    """
    parsed = parse_database_url(url)
    if parsed.get_backend_name() != "postgresql":
        raise SettingsError("Only a Postgres database has a password; set DENTINE__SERVER__DATABASE to its URL.")
    planned = file.with_name("password.next")
    if planned.exists() and _can_connect(url, planned):
        write_password(file, read_password(planned))
    write_private(planned, f"{secrets.token_urlsafe(PASSWORD_BYTES)}\n".encode())
    engine = open_database(with_password_file(url, file))
    try:
        with engine.begin() as connection:
            role = connection.dialect.identifier_preparer.quote(parsed.username or "")
            connection.exec_driver_sql(
                f"ALTER ROLE {role} PASSWORD '{read_password(planned)}'"
            )  # quotes suffice: it consists of letters, digits, - and _
    except sql.exc.OperationalError as problem:
        raise PlatformError(
            f"The database at {parsed.host} does not take a new password ({_reason(problem)}); check that it runs."
        ) from problem
    finally:
        engine.dispose()
    write_password(file, read_password(planned))
    planned.unlink()


def _can_connect(url: str, password_file: Path) -> bool:
    engine = open_database(with_password_file(url, password_file))
    try:
        with engine.connect():
            return True
    except sql.exc.OperationalError:
        return False
    finally:
        engine.dispose()


def _reason(problem: sql.exc.OperationalError) -> str:
    return str(problem.orig).strip().splitlines()[-1]
