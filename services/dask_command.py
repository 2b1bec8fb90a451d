"""``dentine scheduler`` and ``dentine worker``: Dask's own commands, with TLS as the settings say."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NoReturn

import typer

from services.core.dask_config import as_environment

_ALL_TO_DASK = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def add_dask_commands(app: typer.Typer, tls_folder: Callable[[], Path | None]) -> None:
    """Add both commands."""

    @app.command(context_settings=_ALL_TO_DASK)
    def scheduler(context: typer.Context) -> None:
        """Run a Dask scheduler for a server's jobs; takes the options of `dask scheduler`."""
        _become("scheduler", context.args, tls_folder())

    @app.command(context_settings=_ALL_TO_DASK)
    def worker(context: typer.Context) -> None:
        """Run Dask workers for a server's jobs; takes the options of `dask worker`, first of all the scheduler's address."""
        _become("worker", context.args, tls_folder())


def _become(part: Literal["scheduler", "worker"], arguments: Sequence[str], folder: Path | None) -> NoReturn:
    from services.api.dask_tls import Certificates, scheduler_address

    certificates = Certificates.of(folder) if folder is not None else None
    secured = [scheduler_address(argument, certificates) for argument in arguments]
    command = [sys.executable, "-m", "dask", part, *secured, *(certificates.arguments() if certificates else ())]
    os.execve(sys.executable, command, as_environment() | os.environ)  # noqa: S606
