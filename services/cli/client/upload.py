"""``dentine upload``: send a folder to a server."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.arguments import Json, Server
from services.cli.client.connection import connect

if TYPE_CHECKING:
    from services.client.client import Client
    from services.client.uploader import UploadResult
    from services.core.records import JobSpec


def upload(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder capture, or a published capture.")],
    server: Server = None,
    subject: Annotated[str | None, typer.Option(help="Pseudonymous label of the person; never a name.")] = None,
    as_json: Json = False,
) -> None:
    """Upload a capture to a server; the same command again goes on with an upload that broke."""
    with connect(server) as client:
        uploaded = upload_folder(client, folder, subject)
    print(uploaded.model_dump_json() if as_json else uploaded.path)


def upload_folder(client: Client, folder: Path, subject: str | None = None) -> UploadResult:
    """Upload a folder with its progress on standard error."""
    from services.client.upload_progress import UploadView

    with UploadView() as view:
        uploaded = client.upload(folder, view, subject)
    if uploaded.left_out:
        names = ", ".join(uploaded.left_out[:3]) + (
            f" and {len(uploaded.left_out) - 3} more" if len(uploaded.left_out) > 3 else ""
        )
        print(f"Left out, as no part of a capture: {names}.", file=sys.stderr)
    return uploaded


def with_uploaded_source(client: Client, spec: JobSpec) -> JobSpec:
    """Upload a job's capture, or its rig's mouth; return the job with the path of the upload on the server."""
    if spec.rig is not None:
        mouth = Path(upload_folder(client, spec.rig.mouth).path)
        return spec.model_copy(update={"rig": spec.rig.model_copy(update={"mouth": mouth})})
    assert spec.capture is not None
    return spec.model_copy(update={"capture": Path(upload_folder(client, spec.capture).path)})
