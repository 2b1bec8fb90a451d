"""What of a person's data leaves a server is audited with its use, refused beyond the consent, and named in the receipt
of a deletion.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest

from services.api.auth.tokens import Scope
from services.core.provenance.record import PROVENANCE
from tests.support.access_requests import audit
from tests.support.guarded_server import Guarded, guarded


def write_asset(_spec: object, folder: Path, _events: object) -> None:
    """An asset with a consent for research, and a report."""
    (folder / "asset").mkdir()
    consent = {"uses": ["research"], "until": "9999-01-01"}
    (folder / "asset" / PROVENANCE).write_text(json.dumps({"consent": consent}))
    (folder / "asset" / "tooth.ply").write_text("ply")
    (folder / "report.html").write_text("<!doctype html>")
    (folder / "fit.log").write_text("working file")


def made(server: Guarded) -> str:
    """A job that has ended."""
    job: str = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"}).json()["id"]
    deadline_s = time.monotonic() + 20
    while server.ask("GET", f"/v1/jobs/{job}", Scope.READ).json()["state"] != "SUCCEEDED":
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    return job


def limit_consent(server: Guarded, job: str, until: str) -> None:
    file = server.data / "jobs" / job / "asset" / PROVENANCE
    file.write_text(json.dumps({"consent": {"uses": ["research"], "until": until}}))


def test_a_receipt_names_what_has_left(tmp_path: Path) -> None:
    with guarded(tmp_path, write_asset) as server:
        job, other = made(server), made(server)
        artifacts = f"/v1/jobs/{job}/artifacts"
        for _ in range(2):
            assert (
                server.ask("GET", f"{artifacts}/asset/tooth.ply", Scope.READ, params={"for": "research"}).status_code
                == 200
            )
        assert server.ask("GET", f"{artifacts}/report.html", Scope.READ).status_code == 200
        assert server.ask("GET", f"{artifacts}.zip", Scope.ADMIN, params={"for": "research"}).status_code == 200
        assert server.ask("GET", f"{artifacts}/absent.html", Scope.READ).status_code == 404
        assert server.ask("GET", f"/v1/jobs/{other}/artifacts/report.html", Scope.READ).status_code == 200
        rows = [row for row in audit(server) if row["ids"].get("use")]
        assert [row["ids"]["use"] for row in rows] == ["research"] * 3
        receipt = server.ask("DELETE", f"/v1/jobs/{job}", Scope.SUBMIT).json()
        told = [(one["what"], one["who"], one["uses"], one["times"]) for one in receipt["exports"]]
        assert told == [
            ("asset", "of-read", ["research"], 2), ("report.html", "of-read", [], 1),
            ("artifacts.zip", "of-admin", ["research"], 1),
        ]  # fmt: skip
        assert all(one["first_s"] <= one["last_s"] <= receipt["deleted_s"] for one in receipt["exports"])
        assert server.ask("GET", f"/v1/deletions/{job}", Scope.READ).json() == receipt


@pytest.mark.parametrize(
    "path",
    [
        "artifacts/asset/tooth.ply",
        "artifacts/report.html",
        "artifacts/%2E/report.html",
        "artifacts.zip",
        "parameters.csv",
    ],
)
def test_a_use_or_a_day_beyond_the_consent_is_refused(tmp_path: Path, path: str) -> None:
    with guarded(tmp_path, write_asset) as server:
        job = made(server)

        def ask(**query: Any) -> dict[str, Any]:
            answer = server.ask("GET", f"/v1/jobs/{job}/{path}", Scope.READ, params=query)
            return {"status": answer.status_code} | (answer.json() if answer.status_code == 403 else {})

        refused = ask(**{"for": "film"})
        assert (refused["status"], refused["code"]) == (403, "no-consent")
        assert "for research and not for film" in refused["detail"]
        assert refused["detail"].endswith("a job takes up a changed consent when it is run anew.")
        assert ask(**{"for": "research"})["status"] in {200, 404}  # there are no parameters
        limit_consent(server, job, "2020-01-01")
        assert "ended on 2020-01-01" in ask()["detail"]
        assert audit(server)[0]["outcome"] == 403
        answer = server.ask("GET", f"/v1/jobs/{job}/artifacts/fit.log", Scope.READ)
        assert answer.status_code == 200  # no result
