"""The interpreter with programs of others that open assets: Blender as a module, and validators.

``make clients`` sets it up in ``.clients``; the variable ``CLIENTS_PYTHON`` names another one.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

from tests.support.roles import ROOT

VARIABLE = "CLIENTS_PYTHON"


def found_python() -> Path:
    """The interpreter, whether or not it is there."""
    return Path(os.environ.get(VARIABLE, ROOT / ".clients" / "bin" / "python"))


@cache
def lacks(module: str) -> str | None:
    """Why tests with a module of the clients' environment cannot run, or None."""
    python = found_python()
    if not python.is_file():
        return f"no {python}; run make clients, or name an interpreter in {VARIABLE}"
    code = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({module!r}) is None)"
    if subprocess.run([python, "-c", code], check=False).returncode:
        return f"{python} has no {module}; run make clients"
    return None


def client_python(module: str) -> Path:
    """The interpreter that has a module; skips the test where there is none."""
    if reason := lacks(module):
        pytest.skip(reason)
    return found_python()


def run_client(
    module: str, *words: str | Path, environment: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run the clients' interpreter with these words; the caller looks at the return code."""
    return subprocess.run(
        [client_python(module), *words],
        capture_output=True,
        text=True,
        timeout=3000,
        check=False,
        env={**os.environ, **(environment or {})},
    )


@cache
def node_command() -> tuple[tuple[str, ...], dict[str, str]]:
    """Node and an environment in which it finds ``gltf-validator``; skips the test where there is none."""
    home = found_python().parent
    node = shutil.which("node", path=os.pathsep.join([str(home), os.environ.get("PATH", "")]))
    modules = os.pathsep.join([str(home.parent / "node_modules"), os.environ.get("NODE_PATH", "")])
    environment = {**os.environ, "NODE_PATH": modules}
    command = [node or "node", "-e", "require('gltf-validator')"]
    if node is None or subprocess.run(command, check=False, capture_output=True, env=environment).returncode:
        pytest.skip(f"no Node with gltf-validator in {home} or on NODE_PATH; run make clients")
    return (node,), environment
