"""``dentine upload`` and ``dentine submit --upload``: send a folder and show it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from services.core.errors import InputError

if TYPE_CHECKING:
    from services.api.client import Client
    from services.api.uploader import UploadResult
    from services.core.records import JobSpec


def upload_folder(client: Client, folder: Path, subject: str | None = None) -> UploadResult:
    """Upload a folder with its progress on standard error."""
    from services.api.upload_progress import UploadView

    with UploadView() as view:
        uploaded = client.upload(folder, view, subject)
    if uploaded.left_out:
        names = ", ".join(uploaded.left_out[:3]) + (f" and {len(uploaded.left_out) - 3} more" if len(uploaded.left_out) > 3 else "")
        print(f"Left out, as no part of a capture: {names}.", file=sys.stderr)
    return uploaded


def with_uploaded_capture(client: Client, spec: JobSpec, job: Path) -> JobSpec:
    """The job with its capture uploaded and named as the server names it."""
    if spec.capture is None:
        raise InputError(f"Job file {job} names no capture to upload; leave out --upload.")
    return spec.model_copy(update={"capture": Path(upload_folder(client, spec.capture).path)})
