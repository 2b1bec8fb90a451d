"""Programs of others that open an exported file. Each runs in a process of its own, as some of them end by a crash."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

SHIPPED = Path(__file__).parent / "shipped"
TIMEOUT_S = 600.0
"""Longest time, s, that a program may take for one file; Blender starts in a few seconds and builds a mouth in some
tens."""
BLENDER_MODULE = "bpy"


@dataclass(frozen=True)
class Client:
    """A program that was run, and what it found wrong."""

    name: str
    findings: tuple[str, ...]


def check_gltf(file: Path, interpreter: str) -> Client | None:  # noqa: ARG001 - runs on node
    """Errors and warnings of Khronos' validator, the npm package ``gltf-validator``, where node finds it."""
    node = shutil.which("node")
    if node is None or _run([node, "-e", "require('gltf-validator')"]).returncode:
        return None
    return _told("glTF validator", [node, str(SHIPPED / "check_gltf.js"), str(file)])


def check_usd(file: Path, interpreter: str) -> Client | None:
    """Errors of USD's own validators, where a Python has ``pxr``."""
    return _scripted("USD validators", "pxr", "check_usd.py", file, interpreter)


def check_materialx(file: Path, interpreter: str) -> Client | None:
    """Errors of MaterialX's validation, where a Python has ``MaterialX``."""
    return _scripted("MaterialX", "MaterialX", "check_materialx.py", file, interpreter)


def check_mitsuba(file: Path, interpreter: str) -> Client | None:
    """Why Mitsuba does not load and render a scene, where a Python has ``mitsuba``."""
    return _scripted("Mitsuba", "mitsuba", "check_mitsuba.py", file, interpreter)


def _scripted(name: str, module: str, script: str, file: Path, interpreter: str) -> Client | None:
    python = _python_with(module, interpreter)
    return None if python is None else _told(name, [python, str(SHIPPED / script), str(file)])


def check_blender(file: Path, interpreter: str) -> Client | None:
    """Whether the asset's own script builds and saves its scene in Blender, as a module or as a program."""
    python, program = _python_with(BLENDER_MODULE, interpreter), shutil.which("blender")
    with tempfile.TemporaryDirectory() as place:
        saved = Path(place) / "asset.blend"
        words = ["--save", str(saved)]
        if python is not None:
            command = [python, str(file), *words]
        elif program is not None:
            command = [program, "--background", "--python", str(file), "--", *words]
        else:
            return None
        done = _run(command)
        if done.returncode or not saved.is_file():
            return Client("Blender", (_last_line(done, "Blender ended without a scene."),))
    return Client("Blender", ())


def _told(name: str, command: list[str]) -> Client:
    """What a shipped script says: JSON of the program's version and of its findings, in its last line."""
    done = _run(command)
    try:
        told = json.loads(done.stdout.strip().splitlines()[-1])
        return Client(f"{name} {told['version']}".strip(), tuple(str(one) for one in told["findings"]))
    except (ValueError, KeyError, IndexError, TypeError):
        return Client(name, (_last_line(done, "The program ended without an answer."),))


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT_S)  # noqa: S603
    except (OSError, subprocess.TimeoutExpired) as problem:
        return subprocess.CompletedProcess(command, 1, "", str(problem))


def _last_line(done: subprocess.CompletedProcess[str], otherwise: str) -> str:
    return next(iter((done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]), otherwise)


def _python_with(module: str, interpreter: str) -> str | None:
    if importlib.util.find_spec(module) is not None:
        return sys.executable
    code = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({module!r}) is None)"
    return interpreter if interpreter and not _run([interpreter, "-c", code]).returncode else None
