"""Every import of a role's code is among the packages that the role installs; ``tests/pipeline/test_roles.py`` installs
them.
"""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.support.roles import ROLES, ROOT, distributions


@pytest.mark.parametrize("role", ROLES)
def test_every_import_of_a_role_is_among_its_packages(role: str) -> None:
    command = [sys.executable, "-m", "tests.support.role_imports", role]
    answer = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert answer.returncode == 0, answer.stderr
    assert json.loads(answer.stdout.splitlines()[-1]) == []


def test_extras_bring_what_they_name_and_no_more() -> None:
    base, api, worker = (distributions(extras) for extras in ((), ("api",), ("worker",)))
    assert {"structlog", "httpx", "distributed"} <= base
    assert "fastapi" in api - base
    assert {"mitsuba", "opencv-contrib-python-headless"} <= worker - base
    assert not {"fastapi", "uvicorn", "alembic"} & worker
    assert not {"mitsuba", "drjit", "scipy", "pymodbus"} & api
