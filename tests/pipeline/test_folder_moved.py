"""A server whose data folder was moved away says so, and gives no receipt for a deletion that it has not seen."""

from __future__ import annotations

from pathlib import Path

import pytest

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.support.guarded_server import run_nothing
from tests.support.live_server import serving


@pytest.mark.parametrize("another", [False, True])
def test_what_needs_the_files_of_a_folder_that_is_away_is_answered_503(tmp_path: Path, another: bool) -> None:
    data, away = tmp_path / "data", tmp_path / "away"
    with serving(create_app(ServerSettings(data=data), run_nothing)) as client:
        job = client.post("/v1/jobs", json={"capture": "/"}).json()["id"]
        client.get(f"/v1/jobs/{job}/events")
        kept = data / "jobs" / job / "kept.txt"
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text("kept")
        data.rename(away)
        if another:
            data.mkdir()
            (data / "folder.id").write_text("0123456789abcdef\n")
        for method, path, body in (
            ("DELETE", f"/v1/jobs/{job}", None),
            ("GET", f"/v1/jobs/{job}/artifacts", None),
            ("GET", f"/v1/jobs/{job}/artifacts/kept.txt", None),
            ("POST", f"/v1/jobs/{job}/retry", None),
            ("POST", "/v1/jobs", {"capture": "/"}),
        ):
            answer = client.request(method, path, json=body)
            assert (answer.status_code, answer.json()["code"]) == (503, "platform-missing"), (method, path)
            assert "no longer the one that this server opened" in answer.json()["detail"]
        assert (away / "jobs" / job / "kept.txt").read_text() == "kept"
        assert sorted(one.name for one in data.glob("*")) == ["folder.id"] * another, "a folder was made at the place"
        if another:
            (data / "folder.id").unlink()
            data.rmdir()
        away.rename(data)
        assert client.get(f"/v1/jobs/{job}/artifacts/kept.txt").text == "kept"
        receipt = client.delete(f"/v1/jobs/{job}").json()
        assert receipt["files"] >= 1
        assert not kept.exists()
