"""A capture and a job that exist before the generated requests, and are compared to their earlier state afterwards."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from tests.support.uploading import announce, contents_of, send, write_capture


@dataclass(frozen=True)
class KeptData:
    """The server's records of one capture and one job, and the capture's files on its disk."""

    capture: dict[str, Any]
    contents: dict[str, bytes]
    job: dict[str, Any]
    artifacts: dict[str, str]
    events: str
    previews: list[int]

    @classmethod
    def of(cls, client: httpx.Client, data: Path, capture: str, job: str) -> KeptData:
        """Read the present state of a capture and a job."""
        told = client.get(f"/v1/jobs/{job}").raise_for_status().json()
        paths = [file["path"] for file in client.get(f"/v1/jobs/{job}/artifacts").raise_for_status().json()]
        return cls(
            client.get(f"/v1/captures/{capture}").raise_for_status().json(),
            contents_of(data / "captures" / capture),
            {key: value for key, value in told.items() if key != "name"},  # callers who may submit may change the name
            {
                path: hashlib.sha256(
                    client.get(f"/v1/jobs/{job}/artifacts/{path}").raise_for_status().content
                ).hexdigest()
                for path in paths
            },
            client.get(f"/v1/jobs/{job}/events").raise_for_status().text,
            [preview["id"] for preview in client.get(f"/v1/jobs/{job}/previews").raise_for_status().json()["previews"]],
        )

    def losses(self, client: httpx.Client, data: Path) -> list[str]:
        """One sentence for each part that is missing or has changed."""
        try:
            now = KeptData.of(client, data, self.capture["id"], self.job["id"])
        except httpx.HTTPError as problem:
            return [f"the witnesses cannot be read: {problem}"]
        of = ("capture", "contents", "job", "artifacts", "events", "previews")
        return [
            f"{name} of the witnesses changed{_where(getattr(self, name), getattr(now, name))}"
            for name in of
            if getattr(now, name) != getattr(self, name)
        ]


def _where(before: object, now: object) -> str:
    """The entries in which two mappings differ, as text; empty for other objects."""
    if not isinstance(before, dict) or not isinstance(now, dict):
        return ""
    return ": " + ", ".join(
        f"{key} from {str(before.get(key))[:80]} to {str(now.get(key))[:80]}"
        for key in sorted(before.keys() | now.keys())
        if before.get(key) != now.get(key)
    )


def leave_witnesses(client: httpx.Client, data: Path, folder: Path) -> KeptData:
    """Upload a capture and run a job on it; returns their state."""
    contents = contents_of(write_capture(folder))
    capture = announce(client, contents)["id"]
    for path, content in contents.items():
        send(client, capture, path, content).raise_for_status()
    client.post(f"/v1/captures/{capture}/commit").raise_for_status()
    return KeptData.of(client, data, capture, finish_job(client, f"captures/{capture}"))


def finish_job(client: httpx.Client, capture: str) -> str:
    """Submit a job and follow it to its success; returns its id."""
    job: str = client.post("/v1/jobs", json={"capture": capture, "workers": 1}).raise_for_status().json()["id"]
    told = client.get(f"/v1/jobs/{job}/events").raise_for_status().text
    assert told.rstrip().endswith('"SUCCEEDED"'), told[-500:]
    return job
