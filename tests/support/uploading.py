"""Small captures to upload, and single requests of the tus protocol."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import sqlalchemy as sql

from services.api.migrations import upgrade
from services.client.tus import CHUNK_TYPE, VERSION, format_metadata
from services.pipeline.database import open_database, sqlite_url

CAMERA = {
    "name": "c0",
    "size": [8, 6],
    "K": [[10, 0, 4], [0, 10, 3], [0, 0, 1]],
    "camera_from_world": np.eye(4).tolist(),
}
TUS = {"Tus-Resumable": VERSION}


def upgraded(path: Path) -> sql.Engine:
    """Open a database file with all tables."""
    engine = open_database(sqlite_url(path))
    upgrade(engine)
    return engine


def write_capture(folder: Path, images: int = 2, seed: int = 0) -> Path:
    """Write a folder capture of random images that is complete by its description."""
    (folder / "teeth" / "11").mkdir(parents=True)
    rng = np.random.default_rng(seed)
    entries = []
    for number in range(images):
        np.save(folder / f"c0_l{number}.npy", rng.random((6, 8, 1), dtype=np.float32))
        entries.append({"camera": "c0", "light": f"l{number}", "file": f"c0_l{number}.npy"})
    lights = [{"name": f"l{number}", "position_mm": [0, 0, -50], "intensity": [1.0]} for number in range(images)]
    description = {"units": "mm", "channels": ["green"], "cameras": [CAMERA], "lights": lights, "images": entries}
    (folder / "capture.json").write_text(json.dumps(description))
    (folder / "teeth" / "11" / "outer.ply").write_text(f"ply\ncomment {seed}\n")
    return folder


def contents_of(folder: Path) -> dict[str, bytes]:
    """Content of every file by its path relative to the folder."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
    }


def entry(path: str, content: bytes) -> dict[str, Any]:
    """Entry of one file in an upload manifest."""
    return {"path": path, "bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def manifest_of(contents: dict[str, bytes]) -> dict[str, Any]:
    """Upload manifest of these files."""
    return {"files": [entry(path, content) for path, content in contents.items()]}


def announce(client: httpx.Client, contents: dict[str, bytes], **more: Any) -> dict[str, Any]:
    """Announce a capture of these files; returns the server's answer."""
    answer = client.post("/v1/captures", json=manifest_of(contents) | more)
    assert answer.status_code in {200, 201}, answer.text
    return answer.json()


def create_upload(client: httpx.Client, capture: str, path: str, content: bytes) -> str:
    """Create the upload of one file; returns its URL."""
    metadata = format_metadata({"capture": capture, "path": path})
    answer = client.post("/v1/uploads", headers=TUS | {"Upload-Length": str(len(content)), "Upload-Metadata": metadata})
    assert answer.status_code == 201, answer.text
    return answer.headers["location"]


def patch(client: httpx.Client, upload: str, offset: int, content: Any, **headers: str) -> httpx.Response:
    """Send bytes of an upload from an offset on."""
    return client.patch(
        upload, content=content, headers=TUS | {"Upload-Offset": str(offset), "Content-Type": CHUNK_TYPE} | headers
    )


def offset_of(client: httpx.Client, upload: str) -> int:
    """Number of bytes of an upload that the server has stored."""
    return int(client.head(upload, headers=TUS).headers["upload-offset"])


def checksum(content: bytes, algorithm: str = "sha256") -> str:
    """Value of the header Upload-Checksum for some bytes."""
    return f"{algorithm} {base64.b64encode(hashlib.new(algorithm, content).digest()).decode()}"


def send(client: httpx.Client, capture: str, path: str, content: bytes) -> httpx.Response:
    """Create an upload and send the whole file."""
    return patch(client, create_upload(client, capture, path, content), 0, content)


def upload_capture(client: httpx.Client, contents: dict[str, bytes]) -> str:
    """Send and commit a whole capture; returns its id."""
    capture = str(announce(client, contents)["id"])
    for path, content in contents.items():
        assert send(client, capture, path, content).status_code == 204
    assert client.post(f"/v1/captures/{capture}/commit").status_code == 200
    return capture
