"""This project as a user installs it: a wheel, and virtual environments that hold only the wheel and some extras."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType

from tests.support.roles import ROOT

TREE = ("services", "pyproject.toml", "README.md", "LICENSE")
NOT_COPIED = shutil.ignore_patterns("__pycache__", "node_modules")


def build_wheel(folder: Path, added: Mapping[str, str] = MappingProxyType({})) -> Path:
    """Build the wheel from a copy of this tree, with the dashboard's bundle where it has been built; ``added`` gives
    the text of further files.
    """
    tree = folder / "tree"
    tree.mkdir(parents=True)
    for name in TREE:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, tree / name, ignore=NOT_COPIED)
        else:
            shutil.copy(source, tree)
    for path, text in added.items():
        (tree / path).write_text(text)
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(folder / "wheel"),
        str(tree),
    ]
    subprocess.run(command, check=True, cwd=folder)
    (wheel,) = (folder / "wheel").glob("*.whl")
    return wheel


def install(wheel: Path, extras: Iterable[str], folder: Path) -> Path:
    """Make a virtual environment with the wheel and its extras; returns the environment's folder of programs."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    chosen = ",".join(extras)
    command = [str(folder / "bin" / "pip"), "install", "--quiet", f"{wheel}[{chosen}]" if chosen else str(wheel)]
    subprocess.run(command, check=True, cwd=folder)
    return folder / "bin"


def environment_without_this_tree(**settings: str) -> dict[str, str]:
    """This process's environment without the variables that let Python find modules elsewhere, plus settings."""
    return {name: value for name, value in os.environ.items() if name not in {"PYTHONPATH", "VIRTUAL_ENV"}} | settings
