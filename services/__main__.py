"""The ``dentine`` command: composes settings, pipeline and server, and is the only reader of the environment."""

from __future__ import annotations

import json
import os
import sys
from enum import StrEnum
from importlib.metadata import version as installed_version
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, NoReturn

import typer

from services.core.errors import DentineError, InputError, StoreError

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Worker processes; default: the job's.")]
JobFile = Annotated[Path, typer.Argument(metavar="JOB.toml", help="Options of the job.")]


class RendererName(StrEnum):
    """Who renders a phantom."""

    ENGINE = "engine"
    MITSUBA = "mitsuba"


class BoundaryName(StrEnum):
    """Model of the enamel surface."""

    MATCHED = "matched"
    THIN = "thin"


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
    """Put the commands together."""
    from services.client_commands import add_client_commands
    from services.core.settings import read_settings
    from services.dask_command import add_dask_commands
    from services.secrets_command import build_secrets_app
    from services.slab_command import simulate_slab_command
    from services.sphere_command import sphere_command
    from services.token_command import build_token_app

    app = typer.Typer(name="dentine", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.callback()(_root)
    for command in (serve, dome_sim, capture, run, export, phantom, bench):
        app.command()(command)
    app.command("sphere")(sphere_command)
    add_client_commands(app, lambda: read_settings(os.environ))
    add_dask_commands(app, lambda: read_settings(os.environ).server.tls)
    simulate = typer.Typer(no_args_is_help=True, help="Simulate without a capture.", rich_markup_mode=None)
    simulate.callback()(_group)
    simulate.command("slab")(simulate_slab_command)
    app.add_typer(simulate, name="simulate")
    app.add_typer(build_secrets_app(lambda: read_settings(os.environ).server), name="secrets")
    app.add_typer(build_token_app(lambda: read_settings(os.environ).server.database_url), name="token")
    return app


_EXTRAS = MappingProxyType({"serve": "api", "token": "api", "capture": "capture", "dome-sim": "capture", "bench": "worker,bench"})
"""What a command needs beside the base installation; of those that are not named here all that a worker has."""


def _remedy(missing: ModuleNotFoundError) -> str:
    """What to install for the command that was called; a module of our own that is missing is a fault.

    Raises:
        ModuleNotFoundError: it is one of our own.
    """
    if (missing.name or "services").partition(".")[0] == "services":
        raise missing
    extra = _EXTRAS.get(next(iter(sys.argv[1:]), ""), "worker")
    return f"This command needs {missing.name}, which is not installed; pip install 'dentine[{extra}]' brings it."


def _print_version(wanted: bool) -> None:
    if wanted:
        print(installed_version("dentine"))
        raise typer.Exit


def _root(version: Annotated[bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Print the version.")] = False) -> None:
    """From a capture of a person's teeth to a measured, renderable asset."""


def _group() -> None:
    """Keeps ``simulate`` a group while it has one command."""


def run(
    job: JobFile,
    out: Annotated[Path, typer.Option(help="Folder of the results; a folder of the same job resumes it.")],
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Run a job to its asset, without a server."""
    from services.core.settings import read_job
    from services.run_command import run_and_tell

    run_and_tell(read_job(job), out, workers, as_json=as_json)


def capture(job: JobFile, out: Annotated[Path, typer.Option(help="Folder of the job.")]) -> None:
    """Run only the capture of a job that names a rig."""
    from services.core.settings import read_job
    from services.run_command import require_apart

    spec = read_job(job)
    if spec.rig is None:
        raise InputError(f"Job file {job} names no rig to capture with; give it a [rig] table.")
    require_apart(spec, out)
    _run_some(("phantom", "capture") if spec.is_demo else ("capture",), spec, out, again=False)
    print(f"capture: {out / 'capture'}")


def export(out: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a job whose fit is published.")]) -> None:
    """Write the asset and report of a finished fit again."""
    from services.api.pipeline import JOB_FILE
    from services.core.records import JobSpec
    from services.core.store import read_record

    _run_some(("export",), read_record(out / JOB_FILE, JobSpec), out, again=True)
    print(f"report: {out / 'report.html'}")


def _run_some(stages: Any, spec: Any, out: Path, *, again: bool) -> None:
    from services.api.pipeline import run_stages
    from services.api.progress import ProgressView
    from services.run_command import cancelling_on_signals

    with cancelling_on_signals(out), ProgressView() as view:
        run_stages(spec, out, stages, view, workers=1, again=again)


def serve(
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port to listen on; 0 picks a free one; default: the settings'.")] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of the database and the jobs; default: the settings'.")] = None,
) -> None:
    """Serve the API and the dashboard on loopback."""
    from services.api.server import serve as serve_api
    from services.core.settings import read_settings

    server = read_settings(os.environ).server
    changes = {name: value for name, value in (("port", port), ("data", data)) if value is not None}
    serve_api(server.model_copy(update=changes))


def dome_sim(
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen on; 0 picks a free one.")] = 5020,
    lights: Annotated[int, typer.Option(min=1, help="Number of lights.")] = 155,
    watchdog_s: Annotated[float, typer.Option(min=0.05, help="Seconds without a request until the dome goes dark.")] = 2.0,
) -> None:
    """Simulate a dome's Modbus controller."""
    from services.capture.simulator import serve_dome

    serve_dome(host, port, lights, watchdog_s)


def phantom(
    out: Annotated[Path, typer.Option(help="Folder to write the rig, meshes, images and known optics to.")],
    jaw: Annotated[bool, typer.Option("--jaw", help="A whole upper jaw with gums and the mouth's wall instead of one tooth.")] = False,
    subject: Annotated[int | None, typer.Option(min=0, help="Whose jaw: a number draws shapes and optics; default: the average.")] = None,
    scan: Annotated[Path | None, typer.Option(help="Labelled scan (.vtp or .ply) to take the jaw from.")] = None,
    pixel_mm: Annotated[float | None, typer.Option(min=0.01, help="Size of a pixel at the teeth, mm; default: 0.5 for a tooth, 1 for a jaw.")] = None,
    cameras: Annotated[int, typer.Option(min=1, help="Number of cameras.")] = 3,
    lights: Annotated[int, typer.Option(min=1, help="Number of lights, held-out ones included.")] = 8,
    held_out: Annotated[int | None, typer.Option(min=0, help="How many of the lights are kept from the fit; default: every fourth.")] = None,
    channels: Annotated[int, typer.Option(min=1, max=3, help="1 (green) or 3 (red, green, blue).")] = 1,
    boundary: Annotated[BoundaryName, typer.Option(help="Model of the enamel surface.")] = BoundaryName.MATCHED,
    renderer: Annotated[RendererName, typer.Option(help="The project's engine, or stock Mitsuba for a matched boundary.")] = RendererName.ENGINE,
    samples: Annotated[int, typer.Option(min=1, help="Paths per pixel.")] = 1024,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 1,
    outer: Annotated[Path | None, typer.Option(help="Enamel surface to use instead of the procedural one.")] = None,
    dentin: Annotated[Path | None, typer.Option(help="Dentin surface to use instead of the procedural one.")] = None,
    fdi: Annotated[int | None, typer.Option(help="FDI number of the tooth that --outer gives; default: 11. A fit takes dentin's shape from it.")] = None,
    highlights: Annotated[bool, typer.Option("--highlights", help="Add the surface's reflection of each light.")] = False,
    gums: Annotated[bool, typer.Option("--gums", help="Cover the root with gums.")] = False,
    stains: Annotated[bool, typer.Option("--stains", help="Paint stains on the enamel.")] = False,
) -> None:
    """Render a virtual mouth for the simulated cameras to look at."""
    from services.core.folders import require_folder

    require_folder(out, "--out")
    of_jaw = {"--scan": scan is not None}
    of_tooth = {"--outer": outer is not None, "--dentin": dentin is not None, "--fdi": fdi is not None}
    of_tooth |= {"--highlights": highlights, "--gums": gums, "--stains": stains}
    for option, given in (of_tooth if jaw else of_jaw).items():
        if given:
            raise InputError(f"Option {option} is for one tooth; leave out either it or --jaw." if jaw else f"Option {option} is for a jaw; add --jaw.")
    rig: dict[str, Any] = {"cameras": cameras, "lights": lights, "held_out": held_out, "channels": channels, "seed": seed, "samples": samples}
    rig |= {"boundary": boundary.value, "renderer": renderer.value} | ({} if pixel_mm is None else {"pixel_mm": pixel_mm})
    if jaw:
        from services.fit.anatomy.phantom_jaw import write_jaw_phantom

        write_jaw_phantom(out, subject=subject, scan=scan, **rig)
    else:
        from services.fit.anatomy.phantom import write_phantom

        write_phantom(out, outer=outer, dentin=dentin, fdi=fdi, highlights=highlights, gums=gums, stains=stains, subject=subject, **rig)
    print(f"phantom: {out}")


_BENCHMARKS = MappingProxyType(
    {
        "jaw": "services.fit.bench.jaw:run",
        "slab": "services.fit.bench.slab:run",
        "stability": "services.fit.bench.stability:run",
        "tooth": "services.fit.bench.tooth:run",
        "transport-gradient": "services.fit.bench.transport_gradient:run",
        "transport-lights": "services.fit.bench.transport_lights:run",
        "transport-skip": "services.fit.bench.transport_skip:run",
        "transport-stack": "services.fit.bench.transport_stack:run",
    }
)
"""Name -> ``module:function``; the function takes ``quick``, returns JSON values, and may also take ``case``, and ``keep``, which stores unfinished rows."""


def bench(
    name: Annotated[str | None, typer.Argument(help="Benchmark to run, or all; without it they are listed.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Also write the result to this file, and a picture of it beside it.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="A smaller case, for a check.")] = False,
    case: Annotated[str | None, typer.Option(help="Which case of a benchmark that has several.")] = None,
) -> None:
    """Measure speed with its error beside it."""
    import importlib
    import inspect

    if name is None:
        print("\n".join(_BENCHMARKS))
        return
    names = list(_BENCHMARKS) if name == "all" else [name]
    if unknown := [one for one in names if one not in _BENCHMARKS]:
        raise InputError(f"Benchmark {unknown[0]} does not exist; known are {', '.join(_BENCHMARKS)} and all.")
    modules, results = {}, {}
    for one in names:
        address, function = _BENCHMARKS[one].split(":")
        modules[one] = importlib.import_module(address)
        measure = getattr(modules[one], function)
        accepted = inspect.signature(measure).parameters
        options: dict[str, Any] = {"quick": quick}
        if case is not None:
            if "case" not in accepted:
                raise InputError(f"Benchmark {one} has only one case; leave out --case.")
            options["case"] = case
        if "keep" in accepted and json_file is not None and name != "all":
            options["keep"] = lambda rows: json_file.write_text(json.dumps(rows, indent=1) + "\n")
        results[one] = measure(**options)
    text = json.dumps(results if name == "all" else results[name], indent=1)
    print(text)
    if json_file is None:
        return
    json_file.write_text(text + "\n")
    for one in names:
        _draw(modules[one], results[one], json_file.with_name(f"{json_file.stem}-{one}.png") if name == "all" else json_file.with_suffix(".png"))


def _draw(module: Any, rows: list[dict[str, Any]], png: Path) -> None:
    """Draw a benchmark in its module's own way if it has one."""
    try:
        from services.fit.bench.plots import error_against_time, write_png
    except ModuleNotFoundError as missing:
        print(f"{png} was not drawn, as {missing.name} is missing; install the extra bench, pip install 'dentine[bench]'.", file=sys.stderr)
        return
    write_png(getattr(module, "picture", error_against_time)(rows), png)


if __name__ == "__main__":
    main()
