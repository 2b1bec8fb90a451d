"""Known secrets are used in requests that succeed and fail; afterwards no file, log or answer of the server contains
them.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from services.api.auth.sessions import COOKIE, KEY_FILE
from services.api.auth.tokens import Scope
from tests.support.guarded_server import make_token
from tests.support.live_server import connect

FAILING_SERVER = """
import sys
from pathlib import Path
from services.api.jobs.jobs import Jobs
from services.api.server import serve
from services.core.settings import ServerSettings

def run(spec, folder, events):
    raise ZeroDivisionError("a job that breaks")

def break_down(*_):
    raise ZeroDivisionError("a route that breaks")

Jobs.retry = break_down
serve(ServerSettings(port=0, data=Path(sys.argv[1]), access="tokens", job_roots="/"), run)
"""


@pytest.fixture
def failing_server(tmp_path: Path) -> Iterator[tuple[httpx.Client, Path]]:
    """A server whose jobs and whose retry route fail, and the file with all its output."""
    said = tmp_path / "said.txt"
    with said.open("w") as stream:
        command = [sys.executable, "-X", "dev", "-W", "ignore", "-c", FAILING_SERVER, str(tmp_path / "data")]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=stream, text=True, cwd=Path(__file__).parents[2]
        ) as process:
            try:
                assert process.stdout is not None
                with connect(process.stdout.readline().strip()) as client:
                    yield client, said
            finally:
                process.terminate()
                process.wait(30)


@pytest.mark.attack("tokens", "secrets in logs, files and answers")
def test_secrets_are_nowhere_in_what_the_server_writes_and_says(
    failing_server: tuple[httpx.Client, Path], tmp_path: Path
) -> None:
    client, said = failing_server
    answers: list[str] = []

    def ask(
        method: str, path: str, token: str | None, headers: dict[str, str] | None = None, **options: Any
    ) -> httpx.Response:
        signed = {"Authorization": f"Bearer {token}"} if token else {}
        answer = client.request(method, path, headers=signed | (headers or {}), **options)
        answers.append(f"{answer.headers}{answer.text}")
        return answer

    admin, reader = (make_token(tmp_path / "data", f"of-{scope}", scope) for scope in (Scope.ADMIN, Scope.READ))
    guess = "dentine_0123456789ab_a-guess-that-nobody-may-read-again"

    made = ask("POST", "/v1/tokens", admin, json={"name": "made", "scopes": ["read"], "group": "default"})
    answers.clear()  # the answer to a new token is the only one that may contain a secret
    fresh = made.json()["token"]
    signed_in = client.post("/v1/session", headers={"Authorization": f"Bearer {reader}"})
    session = signed_in.cookies[COOKIE]
    client.cookies.clear()
    secrets = [admin, reader, fresh, guess, session]

    job = ask("POST", "/v1/jobs", admin, json={"capture": "/"}).json()["id"]
    ask("GET", f"/v1/jobs/{job}/events", fresh)
    assert ask("POST", f"/v1/jobs/{job}/retry", admin, headers={"Connection": "close"}).status_code == 500
    for token in (guess, f"{reader[:-1]}!", None):
        assert ask("GET", "/v1/jobs", token).status_code == 401
    assert ask("POST", "/v1/jobs", reader, json={}).status_code == 403
    assert ask("GET", "/v1/session", None, headers={"Cookie": f"{COOKIE}={session}"}).status_code == 200
    assert ask("GET", "/v1/session", None, headers={"Cookie": f"{COOKIE}={session}0"}).status_code == 401
    for secret in secrets:
        assert ask("GET", f"/v1/jobs/{secret}", admin).status_code == 404
        assert ask("GET", f"/v1/{secret}", admin).status_code == 404
        assert ask("GET", f"/v1/{secret}", None).status_code == 401
        assert ask("DELETE", f"/v1/tokens/{secret}", guess).status_code == 401
        assert ask("GET", f"/v1/jobs/{job}/artifacts/{secret}", admin).status_code == 404
        assert ask("GET", f"/v1/jobs?limit={secret}", admin).status_code == 422
        assert ask("DELETE", f"/v1/tokens/{secret}", admin).status_code == 404
        assert ask("POST", "/v1/tokens", admin, json={"name": secret, "scopes": ["read"]}).status_code == 422
        assert ask("POST", "/v1/tokens", admin, json={"name": "x", "scopes": [secret]}).status_code == 422
        assert ask("POST", "/v1/tokens", admin, json={secret: 1}).status_code == 422
        assert ask("POST", "/v1/jobs", admin, json={"capture": f"/{secret}"}).status_code == 422
        assert ask("POST", "/v1/jobs", admin, content=secret).status_code == 422
    ask("DELETE", f"/v1/tokens/{fresh.split('_')[1]}", admin)
    assert ask("GET", "/v1/jobs", fresh).status_code == 401
    assert len(ask("GET", "/v1/audit?limit=500", admin).json()["entries"]) > 20
    ask("GET", "/v1/tokens", admin)

    shown = said.read_text()
    assert "a route that breaks" in shown
    written = {path: path.read_bytes() for path in (tmp_path / "data").rglob("*") if path.is_file()}
    assert any(path.suffix == ".sqlite" for path in written)
    key = next(content for path, content in written.items() if path.name == KEY_FILE)
    for secret in (*(one.split("_", 2)[2] for one in secrets), session.rpartition(".")[2], key.hex()):
        assert secret not in shown
        assert not [answer for answer in answers if secret in answer]
        assert not [path for path, content in written.items() if secret.encode() in content]
    assert not [path for path, content in written.items() if key in content and path.name != KEY_FILE]


def test_the_command_line_does_not_repeat_its_token(failing_server: tuple[httpx.Client, Path]) -> None:
    client, _ = failing_server
    guess = "dentine_0123456789ab_a-guess-that-nobody-may-read-again"
    command = [sys.executable, "-m", "services", "cancel", "none", "--server", str(client.base_url)]
    answer = subprocess.run(
        command, capture_output=True, text=True, env=os.environ | {"DENTINE__CLIENT__TOKEN": guess}, check=False
    )
    assert answer.returncode == 8
    assert "unknown, expired or revoked" in answer.stderr
    assert "a-guess" not in answer.stdout + answer.stderr
