"""Assemble the commands, and report every error as one sentence."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version as installed_version
from types import MappingProxyType
from typing import Annotated, NoReturn

import typer

from services.core.errors import DentineError, InputError, StoreError


def main() -> NoReturn:
    """Run the command line; every DentineError becomes one sentence on standard error and its exit status."""
    try:
        build_app()()
    except DentineError as problem:
        print(f"dentine: {problem.message}", file=sys.stderr)
        sys.exit(problem.exit_status)
    except ModuleNotFoundError as problem:
        print(f"dentine: {_remedy(problem)}", file=sys.stderr)
        sys.exit(4)
    except RecursionError:
        print("dentine: What was given nests too deeply to be read; simplify it.", file=sys.stderr)
        sys.exit(InputError.exit_status)
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(141)
    except OSError as problem:
        what = f"{problem.filename or 'A file'} cannot be used ({problem.strerror or problem})"
        print(f"dentine: {what}; check its path, its permissions and the disk.", file=sys.stderr)
        sys.exit(StoreError.exit_status)
    sys.exit(0)


def build_app() -> typer.Typer:
    """Assemble the commands into one application."""
    from services.cli.bench import bench
    from services.cli.capture import capture
    from services.cli.client.calibrations import calibrations
    from services.cli.client.cancel import cancel
    from services.cli.client.delete import delete
    from services.cli.client.demo import demo
    from services.cli.client.download import download
    from services.cli.client.jobs import jobs
    from services.cli.client.keep_calibration import keep_calibration
    from services.cli.client.retry import retry
    from services.cli.client.submit import submit
    from services.cli.client.upload import upload
    from services.cli.client.watch import watch
    from services.cli.dask import add_dask_commands
    from services.cli.dome_sim import dome_sim
    from services.cli.export import export
    from services.cli.lab_demo import lab_demo
    from services.cli.options import options
    from services.cli.phantom import phantom
    from services.cli.raw.board import board_command
    from services.cli.raw.calibrate import calibrate_command
    from services.cli.raw.colmap import colmap_command
    from services.cli.raw.import_folder import import_command
    from services.cli.raw.landmarks import landmarks
    from services.cli.raw.register import register
    from services.cli.reproduce import reproduce
    from services.cli.run import run
    from services.cli.secrets import build_secrets_app
    from services.cli.serve import serve
    from services.cli.shade import shade
    from services.cli.slab import simulate_slab_command
    from services.cli.sphere import sphere_command
    from services.cli.token import build_token_app
    from services.cli.verify import verify
    from services.core.settings import read_settings

    app = typer.Typer(
        name="dentine",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
    )
    app.callback()(_root)
    of_assets = export, shade, verify, reproduce
    local = serve, dome_sim, capture, run, options, *of_assets, landmarks, register, phantom, bench
    kept = keep_calibration, calibrations
    for command in (*local, upload, submit, watch, jobs, cancel, retry, delete, download, demo, *kept):
        app.command()(command)
    add_dask_commands(app, lambda: read_settings(os.environ).server.tls)
    app.command("sphere")(sphere_command)
    app.command("import")(import_command)
    app.command("board")(board_command)
    app.command("calibrate")(calibrate_command)
    app.command("colmap")(colmap_command)
    app.command("lab-demo")(lab_demo)
    simulate = typer.Typer(no_args_is_help=True, help="Simulate without a capture.", rich_markup_mode=None)
    simulate.callback()(_group)
    simulate.command("slab")(simulate_slab_command)
    app.add_typer(simulate, name="simulate")
    app.add_typer(build_secrets_app(lambda: read_settings(os.environ).server), name="secrets")
    app.add_typer(build_token_app(lambda: read_settings(os.environ).server.database_url), name="token")
    return app


_EXTRAS = MappingProxyType(
    {
        "serve": "api",
        "token": "api",
        "capture": "capture",
        "dome-sim": "capture",
        "bench": "worker,bench",
        "colmap": "calibrate,colmap,preprocess",
        "import": "preprocess",
        "landmarks": "calibrate,preprocess",
        "register": "calibrate,preprocess",
    }
)
"""Command -> extras that it needs beside the base installation; commands that are not listed need the extra worker."""


def _remedy(missing: ModuleNotFoundError) -> str:
    """The sentence that names the extra to install for the called command.

    Raises:
        ModuleNotFoundError: the missing module is one of this project's own, which is a fault.
    """
    if (missing.name or "services").partition(".")[0] == "services":
        raise missing
    extra = _EXTRAS.get(next(iter(sys.argv[1:]), ""), "worker")
    return (
        f"This command needs {missing.name}, which is not installed; pip install '.[{extra}]' in the project's folder"
        " brings it."
    )


def _print_version(wanted: bool) -> None:
    if wanted:
        print(installed_version("dentine"))
        raise typer.Exit


def _root(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")
    ] = False,
) -> None:
    """From a capture of a person's teeth to a measured, renderable asset."""


def _group() -> None:
    """Keeps ``simulate`` a group while it has one command."""
