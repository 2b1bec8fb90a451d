"""``dentine token`` makes the first token of a server and ends tokens while it runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.support.command_line import dentine
from tests.support.guarded_server import guarded


def test_a_token_is_made_used_by_the_command_line_and_revoked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The server looks each token up again, and not only a second after it was last used.
    monkeypatch.setattr("services.api.auth.tokens.TRUSTED_S", 0.0)
    data = ("--data", str(tmp_path / "data"))
    made = dentine("token", "create", "laptop", "--scope", "submit", "--expires-days", "7", *data)
    token = made.stdout.strip()
    assert token.startswith("dentine_")
    job = tmp_path / "job.toml"
    job.write_text('capture = "/"\n')
    alone = dentine("token", "create", "reader", "--scope", "read", *data)
    assert "is in no group, so it sees no jobs" in alone.stderr
    member = dentine("token", "create", "member", "--scope", "read", "--group", "surgery", "--json", *data)
    assert (member.stderr, json.loads(member.stdout)["group"]) == ("", "surgery")
    with guarded(tmp_path / "data") as server:
        address = ("--server", str(server.client.base_url))
        assert dentine("submit", str(job), "--watch", *address, DENTINE__CLIENT__TOKEN=token).returncode == 0
        refused = dentine("submit", str(job), *address)
        assert refused.returncode == 8
        assert "reads it from the variable DENTINE__CLIENT__TOKEN" in refused.stderr

        (line,) = [line for line in dentine("token", "list", *data).stdout.splitlines() if "laptop" in line]
        assert token.split("_")[1] in line
        assert "submit" in line
        assert token not in line
        listed = json.loads(dentine("token", "list", "--json", *data).stdout)
        laptop = next(one for one in listed if one["name"] == "laptop")
        assert laptop["expires_s"] - laptop["created_s"] == 7 * 86400
        assert laptop["last_used_s"] >= laptop["created_s"]

        assert dentine("token", "revoke", "laptop", *data).stdout == f"revoked: {laptop['id']} laptop\n"
        ended = dentine("submit", str(job), *address, DENTINE__CLIENT__TOKEN=token)
        assert ended.returncode == 8
        assert "unknown, expired or revoked" in ended.stderr


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (
            ["create", "x", "--scope", "write"],
            "Scope 'write' does not exist; known are read, submit, operate-dome, metrics, admin",
        ),
        (["create", "a b", "--scope", "read"], "Token name 'a b'"),
        (["create", "a", "--scope", "read", "--group", "a/b"], "Group 'a/b' of token a"),
        (["revoke", "nobody"], "There is no token nobody"),
    ],
)
def test_what_is_wrong_is_a_sentence(tmp_path: Path, arguments: list[str], named: str) -> None:
    answer = dentine("token", *arguments, "--data", str(tmp_path))
    assert answer.returncode == 2
    assert answer.stdout == ""
    assert named in answer.stderr


def test_an_open_server_on_the_network_does_not_start(tmp_path: Path) -> None:
    answer = dentine("serve", "--port", "0", "--data", str(tmp_path), DENTINE__SERVER__HOST="0.0.0.0")
    assert answer.returncode == 2
    assert "set DENTINE__SERVER__ACCESS=tokens" in answer.stderr
