"""``dentine run``: run a job to its asset, without a server."""

from __future__ import annotations

import json
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.arguments import JobFile, Json, Workers

if TYPE_CHECKING:
    from services.core.records import JobSpec
    from services.core.results import AssetManifest
    from services.core.stage import StageName


def run(
    job: JobFile,
    out: Annotated[Path, typer.Option(help="Folder of the results; a folder of the same job resumes it.")],
    workers: Workers = None,
    as_json: Json = False,
) -> None:
    """Run a job to its asset, without a server."""
    from services.core.settings import read_job

    run_and_report(read_job(job), out, workers, as_json=as_json)


def run_and_report(spec: JobSpec, out: Path, workers: int | None, *, as_json: bool) -> None:
    """Run a job and print where its results are and how well it fits; the first Ctrl-C cancels it in order.

    Raises:
        typer.Exit: the fit did not converge.
    """
    from services.cli.verdict import require_converged

    asset = run_to_asset(spec, out, workers)
    print(json.dumps(asset_values(asset, out)) if as_json else "\n".join(asset_lines(asset, out)))
    if asset.verdict is not None:
        require_converged(asset.verdict)


def run_to_asset(spec: JobSpec, out: Path, workers: int | None) -> AssetManifest:
    """Run a job and show its progress; the first Ctrl-C cancels it in order."""
    from services.client.progress import ProgressView
    from services.core.records import JOB_FILE
    from services.pipeline.stages import run_job

    require_apart(spec, out)
    with cancelling_on_signals(out), ProgressView() as view:
        # A job that goes on was read before, and may need its capture no more.
        if not (out / JOB_FILE).is_file():
            require_readable(spec)
        asset = run_job(spec, out, view, workers)
    if not view.events:
        print("Every stage was published already; nothing ran.", file=sys.stderr)
    return asset


def asset_values(asset: AssetManifest, out: Path) -> dict[str, Any]:
    """What a program is told of a job's results."""
    return {
        "converged": asset.converged,
        "held_out_error": asset.held_out_error,
        "verdict": None if asset.verdict is None else asset.verdict.model_dump(mode="json"),
        "report": str(out / "report.html"),
        "parameters": str(parameters) if (parameters := out / "parameters.json").exists() else None,
        "files": list(asset.files),
    }


def asset_lines(asset: AssetManifest, out: Path) -> list[str]:
    """What a person is told of a job's results: how well it fits, and where the report is."""
    return [_errors(asset), f"report: {out / 'report.html'}"]


def _errors(asset: AssetManifest) -> str:
    if (verdict := asset.verdict) is None:  # a calibration, or exported by an earlier version
        if asset.held_out_error is None:
            return asset.advice
        return f"held-out error: {100 * asset.held_out_error:.2f} %"
    from services.core.verdict import percent

    return f"{verdict.error_of} error: {percent(verdict.error)}"


def require_readable(spec: JobSpec) -> None:
    """Refuse at once what a slab's fit would refuse when its workers have started.

    Raises:
        CaptureInputError: slab.json is absent or wrong, or names a file that is absent.
    """
    if spec.kind == "slab" and spec.capture is not None:
        from services.core.slab.folder import read_folder

        read_folder(spec.capture)


def require_apart(spec: JobSpec, out: Path) -> None:
    """Refuse results in the folder that they are made from.

    Raises:
        InputError: the results would lie in that folder; the message names both.
    """
    from services.core.files.folders import require_outside

    require_outside(out, spec.capture, "--out")
    if spec.rig is not None and not spec.is_demo:
        require_outside(out, spec.rig.mouth, "--out")


@contextmanager
def cancelling_on_signals(out: Path) -> Iterator[None]:
    """Turn the first Ctrl-C or SIGTERM into a cancel request, so that the lights go off first; a second one stops at
    once.
    """
    from services.core.files.folders import require_folder
    from services.pipeline.stages import request_cancel, withdraw_cancel

    require_folder(out, "Folder")
    is_requested = False
    withdraw_cancel(out)

    def request_once(_signal: int, _frame: FrameType | None) -> None:
        nonlocal is_requested
        if is_requested:
            raise KeyboardInterrupt
        is_requested = True
        out.mkdir(parents=True, exist_ok=True)
        request_cancel(out)
        print("Stopping after the current frame or step; press Ctrl-C again to stop at once.", file=sys.stderr)

    earlier = {number: signal.signal(number, request_once) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, handler)


def run_some(stages: tuple[StageName, ...], spec: JobSpec, out: Path, *, again: bool) -> None:
    """Run some stages of a job and show their progress."""
    from services.client.progress import ProgressView
    from services.pipeline.stages import run_stages

    with cancelling_on_signals(out), ProgressView() as view:
        run_stages(spec, out, stages, view, workers=1, again=again)
