"""Every request that the clients send to a server, as flows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pydantic import SecretStr

from services.client.flows import Flow, HttpRequest, answer
from services.client.uploader import Uploader, UploadProgress, UploadResult
from services.core.light.safety import FlashAcknowledgement
from services.core.records import JobSpec


class Requests:
    """The requests to one server as flows."""

    def __init__(self, server: str, token: SecretStr | None = None) -> None:
        self.server, self._token = server, token

    def connection(self) -> dict[str, Any]:
        """Arguments of ``httpx.Client`` and of ``httpx.AsyncClient``."""
        import httpx

        headers = {} if self._token is None else {"Authorization": f"Bearer {self._token.get_secret_value()}"}
        return {
            "base_url": f"{self.server.rstrip('/')}/v1",
            "headers": headers,
            "timeout": httpx.Timeout(10.0, read=60.0),
            "trust_env": False,
        }

    def submit(self, spec: JobSpec, key: str | None = None, name: str | None = None) -> Flow[dict[str, Any]]:
        """Submit a job."""
        headers = {"Idempotency-Key": key} if key is not None else {}
        label = {} if name is None else {"name": name}
        return self._answer(
            "POST", "/jobs", json=spec.model_dump(mode="json", exclude_none=True) | label, headers=headers
        )

    def jobs(self, limit: int, before: int | None = None, **only: Any) -> Flow[dict[str, Any]]:
        """List at most ``limit`` jobs, newest first; ``only`` are the filters of the list."""
        query = {"limit": limit, "before": before} | only
        return self._answer("GET", "/jobs", params={name: value for name, value in query.items() if value is not None})

    def delete(self, job_id: str) -> Flow[dict[str, Any]]:
        """Delete the stored data of a job."""
        return self._answer("DELETE", f"/jobs/{quote(job_id, safe='')}")

    @staticmethod
    def archive(job_id: str) -> HttpRequest:
        """The request for a job's files as one zip; the client streams its answer."""
        return HttpRequest("GET", f"/jobs/{quote(job_id, safe='')}/artifacts.zip")

    def calibrations(self) -> Flow[list[dict[str, Any]]]:
        """All stored calibrations, newest first, without their content."""
        return answer(self.server, HttpRequest("GET", "/calibrations", {}))

    def calibration(self, name: str) -> Flow[dict[str, Any]]:
        """A stored calibration; its 'option' is what a job takes."""
        return self._answer("GET", f"/calibrations/{quote(name, safe='')}")

    def keep_calibration(self, job_id: str, name: str) -> Flow[dict[str, Any]]:
        """Store the calibration of a job under a name."""
        return self._answer("PUT", f"/jobs/{quote(job_id, safe='')}/calibration/{quote(name, safe='')}")

    def upload(
        self, folder: Path, progress: Callable[[UploadProgress], None] | None = None, subject: str | None = None
    ) -> Flow[UploadResult]:
        """Upload a folder capture and commit it."""
        return Uploader(self.server, progress).upload(folder, subject)

    def get(self, job_id: str) -> Flow[dict[str, Any]]:
        """One job with its stages."""
        return self._answer("GET", f"/jobs/{job_id}")

    def cancel(self, job_id: str) -> Flow[dict[str, Any]]:
        """Ask a job to stop."""
        return self._answer("POST", f"/jobs/{job_id}/cancel")

    def retry(self, job_id: str, flashes: FlashAcknowledgement | None = None) -> Flow[dict[str, Any]]:
        """Queue a failed or cancelled job again; ``flashes`` is its new acknowledgement of faster flashes."""
        body = {} if flashes is None else {"json": {"flashes": flashes.model_dump(mode="json")}}
        return self._answer("POST", f"/jobs/{job_id}/retry", **body)

    def workers(self) -> Flow[dict[str, Any]]:
        """The workers and the present work of each."""
        return self._answer("GET", "/workers")

    def _answer(self, method: str, path: str, **options: Any) -> Flow[dict[str, Any]]:
        return answer(self.server, HttpRequest(method, path, options))
