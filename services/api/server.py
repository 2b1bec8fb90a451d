"""``dentine serve``: one process with the API, the dashboard, the database and the jobs' workers."""

from __future__ import annotations

import fcntl
import logging
import os
import signal
import socket
import stat
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from services.api.app import create_app, is_dashboard_built
from services.api.auth.access import refuse_open_network
from services.api.auth.setup_links import SetupLinks, setup_address
from services.api.jobs.runner import RunJob
from services.core.errors import PlatformError
from services.core.files.private import PRIVATE
from services.core.redaction import redacted
from services.core.settings import ServerSettings
from services.core.stage import StageName
from services.pipeline.database import open_database
from services.pipeline.garbage_collection import freeze_loaded_objects
from services.pipeline.log_stream import queued
from services.pipeline.logs import configure_logs
from services.pipeline.stages import DOORS

if TYPE_CHECKING:
    from types import FrameType

    from uvicorn import Server


def serve(settings: ServerSettings, run: RunJob | None = None, doors: Mapping[StageName, str] = DOORS) -> None:
    """Serve until SIGINT or SIGTERM arrives. The address is printed on standard output once the server listens.

    ``run`` and ``doors`` are those of ``create_app``.

    Raises:
        PlatformError: the port is taken, another server uses the data folder, the data folder or the database cannot be
            used, or the api extra is not installed.
        SettingsError: other machines reach the server and access is open, or the database belongs to another data
            folder.
    """
    refuse_open_network(settings)
    os.umask(PRIVATE)
    try:
        import uvicorn

        from services.api.http.connections import BoundedServer
    except ModuleNotFoundError as problem:
        raise PlatformError("The server's packages are not installed; install dentine[api].") from problem

    with _data_folder_lock(settings.data), closing(_listen(settings)) as listener, queued(sys.stderr) as log:
        if not is_dashboard_built():
            print(
                "The dashboard is not built; run make dashboard and start again. The API works without it.",
                file=sys.stderr,
            )
        host, port = listener.getsockname()[:2]
        print(f"http://{host}:{port}", flush=True)
        configure_logs(log)
        with _translated_write_errors(settings.data):
            proxies, app = settings.trusted_proxies, create_app(settings, run, doors)
            if settings.access == "tokens":
                _log_setup_link(settings, port)
        config = uvicorn.Config(
            app,
            log_config=None,
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=1,
            proxy_headers=bool(proxies),
            forwarded_allow_ips=proxies,
        )
        server = _darken_on_signal(BoundedServer(config, settings.connections), app.state.darken)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: None)  # uvicorn raises the signal again after it has shut down in order
        freeze_loaded_objects()
        server.run(sockets=[listener])


def _log_setup_link(settings: ServerSettings, port: int) -> None:
    """Log the link that makes the first token, if there is no token yet."""
    engine = open_database(settings.database_url)
    try:
        secret = SetupLinks(engine).issue()
    finally:
        engine.dispose()
    if secret is not None:
        link = f"{setup_address(settings, port)}/#/setup/{secret.get_secret_value()}"
        logging.getLogger(__name__).info(
            "Nobody has a token yet. Open this link within an hour to make the administrator's: %s", link
        )


@contextmanager
def _translated_write_errors(data: Path) -> Iterator[None]:
    from sqlalchemy.exc import DBAPIError

    try:
        yield
    except (OSError, DBAPIError) as problem:
        reason = problem.orig if isinstance(problem, DBAPIError) else problem.strerror or problem
        what = f"The server cannot use its data folder {data} or its database ({redacted(str(reason).splitlines()[0])})"
        raise PlatformError(
            f"{what}; free some disk, correct path and permissions, and see that the database answers."
        ) from problem


def _darken_on_signal(server: Server, darken: Callable[[], None]) -> Server:
    """Make the server darken the domes as soon as a signal arrives, before it waits for open requests."""
    leave = server.handle_exit

    def leave_dark(sig: int, frame: FrameType | None) -> None:
        # Darken in a thread of its own, because the code that the signal interrupts may hold any lock.
        threading.Thread(target=darken, name="darken", daemon=True).start()
        leave(sig, frame)

    server.handle_exit = leave_dark  # type: ignore[method-assign]
    return server


def _listen(settings: ServerSettings) -> socket.socket:
    # Name the protocol, because asyncio sets TCP_NODELAY only then. Without it each small answer waits some 40 ms for
    # an acknowledgement.
    listener = socket.socket(
        socket.AF_INET6 if ":" in settings.host else socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP
    )
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
        listener.listen()
    except OSError as problem:
        listener.close()
        raise PlatformError(
            f"Cannot listen on {settings.host}:{settings.port} ({problem.strerror}); choose another --port."
        ) from problem
    return listener


@contextmanager
def _data_folder_lock(data: Path) -> Iterator[None]:
    """Hold the lock of the data folder. The operating system releases it however this process ends."""
    with _translated_write_errors(data):
        data.mkdir(parents=True, exist_ok=True)
        with suppress(PermissionError):  # the folder of another user, who has chosen its permissions
            data.chmod(stat.S_IMODE(data.stat().st_mode) & ~PRIVATE)
        stream = (data / ".lock").open("w")
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PlatformError(
                f"Another server uses the data folder {data}; stop it or choose another --data."
            ) from None
        yield
