"""``dentine scheduler`` and ``dentine worker``: Dask's own commands, with TLS as the settings say and workers that are checked."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer

from services.core.dask_config import as_environment
from services.core.placement import DOME, STAGES, UNLIMITED

_ALL_TO_DASK = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def add_dask_commands(app: typer.Typer, tls_folder: Callable[[], Path | None]) -> None:
    """Add the commands."""

    @app.command(context_settings=_ALL_TO_DASK)
    def scheduler(context: typer.Context) -> None:
        """Run a Dask scheduler for a server's jobs; takes the options of `dask scheduler`."""
        _become("scheduler", context.args, tls_folder())

    @app.command(context_settings=_ALL_TO_DASK)
    def worker(
        context: typer.Context,
        captures_only: Annotated[bool, typer.Option("--captures-only", help="Run captures and nothing else, so that none waits for a fit.")] = False,
    ) -> None:
        """Run Dask workers for a server's jobs; takes the options of `dask worker`, first of all the scheduler's address.

        A worker runs every stage but captures, once it has shown that it can; with `--resources DOME=1` captures too.
        """
        claims = {DOME: 1} if captures_only else {STAGES: UNLIMITED}
        _become("worker", [*_claiming(context.args, claims), "--preload", "services.api.worker_setup"], tls_folder())

    @app.command("worker-health")
    def worker_health() -> None:
        """Say whether this machine's workers are connected and can work; for the health check of a container."""
        from services.api.worker_health import main

        raise typer.Exit(main())


def _claiming(arguments: Sequence[str], claims: Mapping[str, int]) -> list[str]:
    """The arguments with resources added to those that they name themselves."""
    others, named = list[str](), dict[str, str]()
    rest = iter(arguments)
    for argument in rest:
        option, is_joined, value = argument.partition("=")
        if option == "--resources":
            named |= dict(part.split("=", 1) for part in (value if is_joined else next(rest, "")).split() if "=" in part)
        else:
            others.append(argument)
    named = {name: str(amount) for name, amount in claims.items()} | named
    return [*others, "--resources", " ".join(f"{name}={amount}" for name, amount in named.items())]


def _become(part: Literal["scheduler", "worker"], arguments: Sequence[str], folder: Path | None) -> NoReturn:
    from services.api.dask_tls import Certificates, scheduler_address

    certificates = Certificates.of(folder) if folder is not None else None
    secured = [scheduler_address(argument, certificates) for argument in arguments]
    command = [sys.executable, "-m", "dask", part, *secured, *(certificates.arguments() if certificates else ())]
    os.execve(sys.executable, command, as_environment() | os.environ)  # noqa: S606
