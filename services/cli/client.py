"""The commands that speak to a server: submit, watch, jobs, upload, download and the like. They need the base install alone."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.core.errors import InputError, JobCancelledError

if TYPE_CHECKING:
    from services.client.client import Client
    from services.core.records import Verdict
    from services.core.settings import Settings

Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Server = Annotated[str | None, typer.Option(help="Address of the server, such as http://127.0.0.1:8000; default: the settings'.")]
JobId = Annotated[str, typer.Argument(metavar="ID", help="Id that submit printed.")]
JobFile = Annotated[Path, typer.Argument(metavar="JOB.toml", help="Options of the job.")]
MOST_AT_ONCE = 500
"""Jobs that a server lists in one answer."""


def add_client_commands(app: typer.Typer, read: Callable[[], Settings]) -> None:
    """Add the commands; ``read`` gives the settings."""

    def connect(server: str | None) -> Client:
        from services.client.client import Client

        settings = read()
        return Client(server or f"http://{settings.server.host}:{settings.server.port}", settings.client.token)

    _add_submission(app, connect)
    _add_care(app, connect)
    _add_demonstration(app, connect)


def _add_submission(app: typer.Typer, connect: Callable[[str | None], Client]) -> None:
    @app.command()
    def upload(
        folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder capture, or a published capture.")],
        server: Server = None,
        subject: Annotated[str | None, typer.Option(help="Pseudonymous label of the person; never a name.")] = None,
        as_json: Json = False,
    ) -> None:
        """Upload a capture to a server; the same command again goes on with an upload that broke."""
        from services.cli.upload import upload_folder

        with connect(server) as client:
            uploaded = upload_folder(client, folder, subject)
        print(uploaded.model_dump_json() if as_json else uploaded.path)

    @app.command()
    def submit(
        job: JobFile,
        server: Server = None,
        send: Annotated[bool, typer.Option("--upload", help="Upload the job's capture, or its rig's mouth, first.")] = False,
        calibration: Annotated[str | None, typer.Option(metavar="NAME", help="Calibration that the server stores, in place of the job's own.")] = None,
        key: Annotated[str | None, typer.Option(help="Idempotency key; submitting twice with one key makes one job.")] = None,
        name: Annotated[str | None, typer.Option(help="Label of the job, up to 80 characters.")] = None,
        follow: Annotated[bool, typer.Option("--watch", help="Watch the job until it ends.")] = False,
        as_json: Json = False,
    ) -> None:
        """Submit a job to a server."""
        from services.core.settings import read_job

        spec = read_job(job)
        with connect(server) as client:
            if send:
                from services.cli.upload import with_uploaded_source

                spec = with_uploaded_source(client, spec)
            if calibration is not None:
                spec = spec.model_copy(update={"calibration": Path(client.calibration(calibration)["option"])})
            created = client.submit(spec, key, name)
            print(json.dumps(created) if as_json else created["id"])
            if follow:
                watch_job(client, created["id"])


def _add_demonstration(app: typer.Typer, connect: Callable[[str | None], Client]) -> None:
    @app.command()
    def demo(
        server: Annotated[str | None, typer.Option(help="Server to run it on, such as http://127.0.0.1:8000; default: this machine, without a server.")] = None,
        out: Annotated[Path, typer.Option(help="Folder of the results, where no server is given; the same folder goes on with it.")] = Path("demo"),
        name: Annotated[str, typer.Option(help="Label of the job on the server.")] = "Demonstration",
        as_json: Json = False,
    ) -> None:
        """Run the demonstration: a simulated dome lights a virtual incisor, and the fit finds its optics; a few minutes on two cores."""
        from services.api.presets import find_preset
        from services.core.records import JobSpec

        spec = JobSpec.model_validate(find_preset("demo").options)
        if server is None:
            from services.cli.run import run_and_tell

            run_and_tell(spec, out, None, as_json=as_json)
            return
        with connect(server) as client:
            job_id = client.submit(spec, name=name)["id"]
            print(f"job: {job_id}", file=sys.stderr)
            watch_job(client, job_id, as_json=as_json)
        if not as_json:
            print(f"report: {server.rstrip('/')}/v1/jobs/{job_id}/artifacts/report.html")


def _add_care(app: typer.Typer, connect: Callable[[str | None], Client]) -> None:
    @app.command()
    def watch(job_id: JobId, server: Server = None, as_json: Json = False) -> None:
        """Watch a job until it ends; the exit status is the job's, or 9 where its fit did not converge."""
        with connect(server) as client:
            watch_job(client, job_id, as_json=as_json)

    @app.command()
    def jobs(
        server: Server = None,
        state: Annotated[list[str] | None, typer.Option(help="Only jobs in this state, such as failed; may be given several times.")] = None,
        kind: Annotated[str | None, typer.Option(help="Only jobs of this kind: tooth or jaw.")] = None,
        capture: Annotated[str | None, typer.Option(help="Only jobs with this text in the path of their capture or rig's mouth.")] = None,
        limit: Annotated[int, typer.Option(min=1, help="Most jobs to list.")] = 50,
        as_json: Json = False,
    ) -> None:
        """List the jobs of a server, newest first."""
        only = {"state": [one.upper() for one in state or ()] or None, "kind": kind, "capture": capture}
        with connect(server) as client:
            found = _list(client, limit, only)
        print(json.dumps(found) if as_json else "\n".join(map(_line, found)) or "There is no such job.")

    @app.command()
    def cancel(job_id: JobId, server: Server = None) -> None:
        """Cancel a job; the lights go off first and what is published is kept."""
        with connect(server) as client:
            print(client.cancel(job_id)["state"])

    @app.command()
    def retry(job_id: JobId, server: Server = None) -> None:
        """Queue a failed or cancelled job again; it resumes from what it had published."""
        with connect(server) as client:
            print(client.retry(job_id)["state"])

    @app.command()
    def delete(job_id: JobId, server: Server = None, as_json: Json = False) -> None:
        """Delete a job that has ended, with all its files; prints the receipt."""
        with connect(server) as client:
            receipt = client.delete(job_id)
        print(json.dumps(receipt) if as_json else f"deleted: {job_id}, {receipt['files']} files of {receipt['bytes']} bytes, digest {receipt['digest']}")

    @app.command()
    def download(
        job_id: JobId,
        out: Annotated[Path | None, typer.Option(metavar="FILE.zip", help="Where to write it; default: dentine-ID.zip here.")] = None,
        server: Server = None,
    ) -> None:
        """Download all files of a job as one zip: report, parameters, asset and pictures."""
        target = out or Path(f"dentine-{job_id}.zip")
        if target.is_dir():
            raise InputError(f"{target} is a folder; name the zip file to write with --out.")
        with connect(server) as client:
            client.download(job_id, target)
        print(target)


def watch_job(client: Client, job_id: str, *, as_json: bool = False) -> None:
    """Show a job until it ends.

    Raises:
        JobCancelledError: it was. typer.Exit: it failed, with the status of its own, or its fit did not converge.
    """
    from services.client.progress import ProgressView

    with ProgressView(lambda: client.get(job_id)["remaining"]) as view:
        for event in client.events(job_id):
            view(event)
    job = client.get(job_id)
    print(json.dumps(job) if as_json else shown_state(job))
    if job["state"] == "CANCELLED":
        raise JobCancelledError(f"Job {job_id} was cancelled; dentine retry {job_id} resumes it.")
    if failure := job["failure"]:
        print(f"dentine: {failure['message']}", file=sys.stderr)
        raise typer.Exit(failure["exit_status"])
    if (verdict := job["verdict"]) is not None:
        from services.core.records import Verdict

        require_converged(Verdict.model_validate(verdict))


def require_converged(verdict: Verdict) -> None:
    """Say on standard error how well a fit went.

    Raises:
        typer.Exit: it did not converge.
    """
    from services.core.verdict import NOT_CONVERGED_STATUS

    print(verdict.headline, file=sys.stderr)
    if not verdict.converged:
        if verdict.advice:
            print(verdict.advice, file=sys.stderr)
        raise typer.Exit(NOT_CONVERGED_STATUS)


def shown_state(job: dict[str, Any]) -> str:
    """A job's state, and of one that succeeded whether its fit did: the same word that the page shows."""
    verdict = job["verdict"]
    return "NOT CONVERGED" if verdict is not None and not verdict["converged"] else str(job["state"])


def _list(client: Client, limit: int, only: dict[str, Any]) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    before = None
    while len(found) < limit:
        page = client.jobs(min(limit - len(found), MOST_AT_ONCE), before, **only)
        found += page["jobs"]
        if (before := page["next_before"]) is None:
            break
    return found


def _line(job: dict[str, Any]) -> str:
    submitted = datetime.fromtimestamp(job["created_s"], UTC).strftime("%Y-%m-%d %H:%M UTC")
    source = job["spec"]["rig"]["mouth"] if job["spec"]["rig"] else job["spec"]["capture"]
    return f"{job['id']}  {shown_state(job):<13}  {submitted}  {job['name'] or '-'}  {source}"
