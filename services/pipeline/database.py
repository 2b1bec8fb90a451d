"""The database behind a URL: SQLite for one machine, Postgres for several. In both, data that were read inside
``writing`` stay valid until its end.

SQLite runs in WAL mode with ``BEGIN IMMEDIATE`` and a busy timeout, because its defaults lose updates in transactions
that read and then write. On Postgres the same transactions take one advisory lock. So there is one writer at a time,
events become visible in the order of their ids, and a reader that remembers the last id it saw misses none.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sql
from sqlalchemy.dialects import sqlite

from services.core.errors import PlatformError, SettingsError

BUSY_MS = 5000
"""Longest time, ms, that a writer waits for a writer of another process."""
WRITER_WAIT_S = 5.0
"""Longest time, s, that a writer first waits for other writers of its own process."""
MAX_CONNECTIONS = 64
"""Number of connections that stay open to a file: as many as a server has threads with queries."""
WRITER_LOCK = 0x64656E74
"""Number of the advisory lock: the letters "dent"."""
MAX_ID = 2**31 - 1
"""Largest id of a row: the largest INTEGER of Postgres, which refuses a larger number even in a comparison."""

POSTGRES_SILENCE_S = 15
"""Time, s, without a sign of life after which each side of a connection counts the other as lost, also in the middle of
a transaction."""

PASSWORD_FILE = "password_file"  # noqa: S105 - a name
"""Parameter of a database's URL that this project adds to Postgres' own: the file that holds the password, so that no
password is part of the URL."""
PATIENCE_S = 600.0
"""Longest time, s, that a process at work on a job waits for a database that does not answer."""

DISK_FULL = "53100"
"""Postgres' code of the error that says that its disk is full."""

T = TypeVar("T")
metadata = sql.MetaData()


def sqlite_url(path: Path) -> str:
    """URL of a database file."""
    return f"sqlite:///{path}"


def open_database(url: str) -> sql.Engine:
    """Open a database; nothing is created in it.

    Args:
        url: URL of the database. It may name the file of the password, ``?password_file=PATH``, which is read for every
            connection, so that a changed password needs no restart.

    Raises:
        SettingsError: the URL is not one of SQLite or Postgres. PlatformError: Postgres' driver is not installed.
    """
    parsed = parse_database_url(url)
    if parsed.get_backend_name() == "sqlite":
        if parsed.database:
            Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
        return _sqlite(parsed)
    if parsed.get_backend_name() != "postgresql":
        raise SettingsError(f"The database {parsed.get_backend_name()!r} is not supported; use sqlite or postgresql.")
    password_file = parsed.query.get(PASSWORD_FILE)
    parsed = parsed.difference_update_query([PASSWORD_FILE])
    try:
        engine = sql.create_engine(
            parsed.set(drivername="postgresql+psycopg"),
            pool_pre_ping=True,
            hide_parameters=True,
            connect_args=_keepalive_options(parsed),
        )
    except ModuleNotFoundError as problem:
        raise PlatformError("Postgres' driver is not installed; install dentine[postgres].") from problem
    if isinstance(password_file, str):
        _read_password_at_each_connection(engine, Path(password_file))
    return engine


def parse_database_url(url: str) -> sql.URL:
    """Parse a database's URL.

    Raises:
        SettingsError: it is malformed; the message repeats no part of it, because one of them is a password.
    """
    try:
        return sql.make_url(url)
    except (sql.exc.ArgumentError, ValueError):
        what = "The database's URL is malformed; give sqlite:///FILE or postgresql://USER@HOST/NAME"
        advice = "with the password in the file that DENTINE__SERVER__DATABASE_PASSWORD_FILE names"
        raise SettingsError(
            f"{what}, {advice}: in a URL, characters such as / @ # must be written as %2F %40 %23."
        ) from None


def with_password_file(url: str, path: Path) -> str:
    """The URL of a database with the file of its password in place of the password."""
    parsed = parse_database_url(url)
    query = dict(parsed.query) | {PASSWORD_FILE: str(path)}
    # The URL is made anew, because `URL.set` cannot remove a password: None means "leave it unchanged" there.
    without = sql.URL.create(parsed.drivername, parsed.username, None, parsed.host, parsed.port, parsed.database, query)
    return without.render_as_string(hide_password=False)


def read_password(path: Path) -> str:
    """Read the password in a file, without the end of its line.

    Raises:
        SettingsError: the file is absent, unreadable, or empty.
    """
    try:
        password = path.read_text().rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as problem:
        reason = getattr(problem, "strerror", None) or "it is no text"
        raise SettingsError(
            f"The file of the database's password, {path}, cannot be read ({reason}); correct it or the setting."
        ) from problem
    if not password:
        raise SettingsError(f"The file of the database's password, {path}, is empty; write the password into it.")
    return password


def _read_password_at_each_connection(engine: sql.Engine, path: Path) -> None:
    @sql.event.listens_for(engine, "do_connect")
    def _connect(_dialect: Any, _record: Any, _arguments: Any, options: dict[str, Any]) -> None:
        options["password"] = read_password(path)


def retry_while_lost(call: Callable[[], T], seconds: float = PATIENCE_S) -> T:
    """Make a call, and repeat it for up to ``seconds`` while the database does not answer."""
    import stamina

    def is_lost(problem: Exception) -> bool:
        return isinstance(problem, sql.exc.OperationalError | sql.exc.InterfaceError) or (
            isinstance(problem, sql.exc.DBAPIError) and problem.connection_invalidated
        )

    return stamina.RetryingCaller(attempts=None, timeout=seconds, wait_initial=0.1, wait_max=2.0)(is_lost, call)


def is_full(problem: BaseException) -> bool:
    """Whether a database has refused a write because its disk is full."""
    cause = getattr(problem, "orig", None)
    return getattr(cause, "sqlite_errorname", None) == "SQLITE_FULL" or getattr(cause, "sqlstate", None) == DISK_FULL


class Query:
    """A frequent query, built and compiled once.

    SQLite's driver runs the text without a transaction, because one statement sees one state of the database;
    SQLAlchemy's own work around a query takes four times as long as the query.

    Args:
        statement: the query, with named parameters.
    """

    def __init__(self, statement: sql.Select[Any]) -> None:
        self.statement = statement

    def rows(self, engine: sql.Engine, **values: str | float | None) -> Sequence[Sequence[Any]]:
        """Run the query and return its rows, with columns in the statement's order.

        Raises:
            sqlalchemy.exc.DBAPIError: the database does not answer.
        """
        if engine.dialect.name != "sqlite":
            with engine.connect() as connection:
                return connection.execute(self.statement, values).all()
        text, constants = self._compiled
        try:
            with closing(engine.raw_connection()) as borrowed:
                rows: list[tuple[Any, ...]] = borrowed.cursor().execute(text, constants | values).fetchall()
        except sqlite3.Error as problem:  # also raised by connecting, where SQLAlchemy does not translate it
            raise sql.exc.DBAPIError.instance(
                text, values, problem, sqlite3.Error, hide_parameters=True, dialect=engine.dialect
            ) from problem
        return rows

    @cached_property
    def _compiled(self) -> tuple[str, dict[str, Any]]:
        """The text of the statement, and the values of the parameters that SQLAlchemy has named itself."""
        compiled = self.statement.compile(dialect=sqlite.dialect(paramstyle="named"))
        return str(compiled), {name: value for name, value in compiled.params.items() if value is not None}


@contextmanager
def writing(engine: sql.Engine) -> Iterator[sql.Connection]:
    """A transaction that excludes other writers from its first statement on.

    Raises:
        sqlalchemy.exc.OperationalError: others write for too long, or the database does not answer.
    """
    with _writer_lock(engine), engine.connect() as connection, connection.execution_options(writes=True).begin():
        if engine.dialect.name == "postgresql":
            connection.execute(sql.select(sql.func.pg_advisory_xact_lock(WRITER_LOCK)))
        yield connection


@contextmanager
def _writer_lock(engine: sql.Engine) -> Iterator[None]:
    lock: threading.Lock | None = engine.get_execution_options().get("writer_lock")
    if lock is None:
        yield
        return
    if not lock.acquire(timeout=WRITER_WAIT_S):
        raise sql.exc.OperationalError(
            "BEGIN IMMEDIATE", None, TimeoutError("other writers of this process have not ended")
        )
    try:
        yield
    finally:
        lock.release()


def _keepalive_options(url: sql.URL) -> dict[str, Any]:
    # By default a connection over a cut network hangs for a quarter of an hour, and the server keeps the locks of its
    # transaction for two hours.
    third_s, silence_ms = POSTGRES_SILENCE_S // 3, 1000 * POSTGRES_SILENCE_S
    probes = {"keepalives_idle": third_s, "keepalives_interval": third_s, "keepalives_count": 2}
    theirs = {f"tcp_{name}": value for name, value in probes.items()}
    theirs |= {"tcp_user_timeout": silence_ms, "idle_in_transaction_session_timeout": silence_ms}
    ours: dict[str, Any] = probes | {"tcp_user_timeout": silence_ms, "connect_timeout": BUSY_MS // 1000}
    ours["options"] = " ".join(f"-c {name}={value}" for name, value in theirs.items())
    return {name: value for name, value in ours.items() if name not in url.query}  # the URL has precedence


def _sqlite(url: sql.URL) -> sql.Engine:
    # SQLite lets waiting writers sleep and try again, up to a tenth of a second each time, so writers of one process
    # take a lock of their own first. Connections stay open, because opening one costs more than most queries. Errors
    # end in logs, so they hide the parameters of queries.
    engine = sql.create_engine(
        url, hide_parameters=True, pool_size=MAX_CONNECTIONS, execution_options={"writer_lock": threading.Lock()}
    )

    @sql.event.listens_for(engine, "connect")
    def _connect(connection: Any, _: Any) -> None:
        connection.isolation_level = None  # the driver then emits no BEGIN; _begin does
        connection.execute(f"PRAGMA busy_timeout={BUSY_MS}")
        connection.execute("PRAGMA journal_mode=WAL")
        connection.execute("PRAGMA synchronous=NORMAL")
        connection.execute("PRAGMA secure_delete=ON")  # deleted content is overwritten

    @sql.event.listens_for(engine, "begin")
    def _begin(connection: sql.Connection) -> None:
        if connection.get_execution_options().get("writes"):
            connection.exec_driver_sql("BEGIN IMMEDIATE")
        else:
            # This statement takes no lock yet and cannot fail, so SQLAlchemy need not handle its errors.
            connection.connection.cursor().execute("BEGIN")

    return engine
