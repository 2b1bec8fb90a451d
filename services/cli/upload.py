"""``dentine upload`` and ``dentine submit --upload``: send a folder and show it."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from services.client.client import Client
    from services.client.uploader import UploadResult
    from services.core.records import JobSpec


def upload_folder(client: Client, folder: Path, subject: str | None = None) -> UploadResult:
    """Upload a folder with its progress on standard error."""
    from services.client.upload_progress import UploadView

    with UploadView() as view:
        uploaded = client.upload(folder, view, subject)
    if uploaded.left_out:
        names = ", ".join(uploaded.left_out[:3]) + (f" and {len(uploaded.left_out) - 3} more" if len(uploaded.left_out) > 3 else "")
        print(f"Left out, as no part of a capture: {names}.", file=sys.stderr)
    return uploaded


def with_uploaded_source(client: Client, spec: JobSpec) -> JobSpec:
    """The job with its capture, or its rig's mouth, uploaded and named as the server names it."""
    if spec.rig is not None:
        mouth = Path(upload_folder(client, spec.rig.mouth).path)
        return spec.model_copy(update={"rig": spec.rig.model_copy(update={"mouth": mouth})})
    assert spec.capture is not None
    return spec.model_copy(update={"capture": Path(upload_folder(client, spec.capture).path)})
