"""Guessed tokens never pass and leave few rows in the audit log, and a valid token from the same address still works.
The slow test tries ten thousand guesses.
"""

from __future__ import annotations

import secrets
from pathlib import Path

import pytest

from services.api.auth.tokens import Scope
from services.core.settings import RateSettings
from tests.support.guarded_server import guarded

LIMIT = 50


@pytest.mark.parametrize("guesses", [1_000, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.attack("tokens", "guessing")
def test_guesses_never_pass_and_a_valid_token_does(tmp_path: Path, guesses: int) -> None:
    with guarded(tmp_path, rates=RateSettings(refusals_per_minute=LIMIT)) as server:
        known = list(server.tokens.values())
        statuses: dict[int, int] = {}
        valid = []
        for number in range(guesses):
            token = known[number % len(known)]
            prefix = token[:21] if number % 2 else f"dentine_{secrets.token_hex(6)}_"
            kinds = {0: secrets.token_urlsafe(32), 1: token[21:-1] + chr(ord(token[-1]) ^ 1), 2: token[21:][::-1]}
            answer = server.client.get("/v1/jobs", headers={"Authorization": f"Bearer {prefix}{kinds[number % 3]}"})
            statuses[answer.status_code] = statuses.get(answer.status_code, 0) + 1
            if number % 100 == 0:
                valid.append(server.ask("GET", "/v1/jobs", Scope.READ).status_code)
        assert set(statuses) == {401, 429}
        assert sum(statuses.values()) == guesses
        assert statuses[401] < guesses / 2
        assert valid == [200] * (guesses // 100)
        rows = server.ask("GET", "/v1/audit", Scope.ADMIN, params={"limit": 500, "who": "unknown"}).json()["entries"]
        outcomes = [row["outcome"] for row in rows]
        assert outcomes.count(401) == statuses[401]
        assert 1 <= outcomes.count(429) < statuses[429] / LIMIT
        assert len(rows) == outcomes.count(401) + outcomes.count(429)
