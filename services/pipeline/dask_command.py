"""Dask's own commands with ``LastingSecurity``: ``python -m services.pipeline.dask_command scheduler ...``."""

from __future__ import annotations


def main() -> None:
    """Run the command; every scheduler, nanny and worker that it makes has its certificates in ``LastingSecurity``."""
    from dask.cli import run_cli
    from distributed import nanny, scheduler, worker

    from services.pipeline.dask_security import LastingSecurity

    # The commands take files of certificates as options and give no way to name a class.
    for module in (nanny, scheduler, worker):
        module.Security = LastingSecurity
    run_cli()


if __name__ == "__main__":
    main()
