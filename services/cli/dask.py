"""``dentine scheduler`` and ``dentine worker``: Dask's own commands, with TLS according to the settings, and with
checks of the workers.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer

from services.core.errors import SettingsError
from services.core.files.private import PRIVATE
from services.core.placement import DOME, STAGES, UNLIMITED
from services.pipeline.dask_config import as_environment

_ADDRESS = re.compile(r"([a-z]+://)?[^-\s][^\s]*:\d+")
_ALL_TO_DASK = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def add_dask_commands(app: typer.Typer, tls_folder: Callable[[], Path | None]) -> None:
    """Add the commands ``scheduler``, ``worker`` and ``worker-health`` to an application."""

    @app.command(context_settings=_ALL_TO_DASK)
    def scheduler(context: typer.Context) -> None:
        """Run a Dask scheduler for a server's jobs; takes the options of `dask scheduler`."""
        _exec_dask("scheduler", context.args, tls_folder())

    @app.command(context_settings=_ALL_TO_DASK)
    def worker(
        context: typer.Context,
        captures_only: Annotated[
            bool, typer.Option("--captures-only", help="Run captures and nothing else, so that none waits for a fit.")
        ] = False,
    ) -> None:
        """Run Dask workers for a server's jobs; takes the options of `dask worker`, first of all the scheduler's
        address.

        A worker runs every stage but captures, once it has shown that it can; with `--resources DOME=1` captures too.
        """
        require_scheduler_named(context.args, os.environ)
        default_resources = {DOME: 1} if captures_only else {STAGES: UNLIMITED}
        _exec_dask(
            "worker",
            [*_with_resources(context.args, default_resources), "--preload", "services.pipeline.worker_setup"],
            tls_folder(),
        )

    @app.command("worker-health")
    def worker_health() -> None:
        """Say whether this machine's workers are connected and can work; for the health check of a container."""
        from services.pipeline.worker_health import main

        raise typer.Exit(main())


def _with_resources(arguments: Sequence[str], default_resources: Mapping[str, int]) -> list[str]:
    """The arguments with the default resources added to their own ``--resources``, whose amounts have precedence."""
    others, resources = list[str](), dict[str, str]()
    rest = iter(arguments)
    for argument in rest:
        option, is_joined, value = argument.partition("=")
        if option == "--resources":
            resources |= dict(
                part.split("=", 1) for part in (value if is_joined else next(rest, "")).split() if "=" in part
            )
        else:
            others.append(argument)
    resources = {name: str(amount) for name, amount in default_resources.items()} | resources
    return [*others, "--resources", " ".join(f"{name}={amount}" for name, amount in resources.items())]


def require_scheduler_named(arguments: Sequence[str], environment: Mapping[str, str]) -> None:
    """Refuse to start workers that know no scheduler, which Dask itself answers with a traceback.

    Raises:
        SettingsError: neither an address nor a file is given.
    """
    known = "--scheduler-file", "--help", "--version", "--preload"
    if "DASK_SCHEDULER_ADDRESS" in environment or any(one.partition("=")[0] in known for one in arguments):
        return
    if not any(_ADDRESS.fullmatch(one) for one in arguments):
        raise SettingsError("No scheduler is named; give its address first, as in: dentine worker tcp://HOST:8786.")


def _exec_dask(part: Literal["scheduler", "worker"], arguments: Sequence[str], folder: Path | None) -> NoReturn:
    from services.pipeline.dask_tls import Certificates, scheduler_address

    certificates = Certificates.of(folder) if folder is not None else None
    secured = [scheduler_address(argument, certificates) for argument in arguments]
    command = [
        sys.executable,
        "-m",
        "services.pipeline.dask_command",
        part,
        *secured,
        "--preload",
        "services.pipeline.close_http",
        *(certificates.arguments() if certificates else ()),
    ]
    os.umask(PRIVATE)  # inherited by the command that is started: a worker writes captures of people, too
    os.execve(sys.executable, command, as_environment() | os.environ)  # noqa: S606
