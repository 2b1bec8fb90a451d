"""What several test files or processes need, computed by the first of them and read by the others."""

from __future__ import annotations

import fcntl
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest

Value = TypeVar("Value")


def run_folder(factory: pytest.TempPathFactory) -> Path:
    """Temporary folder of the whole run, which all worker processes of pytest-xdist share."""
    own = factory.getbasetemp()
    return own.parent if own.name.startswith("popen-") else own


def folder_once(factory: pytest.TempPathFactory, name: str, fill: Callable[[Path], None]) -> Path:
    """Folder ``name`` of the run, filled by whoever asks first; the others wait. Nobody may change it afterwards."""
    folder, lock = (run_folder(factory) / f"{name}{suffix}" for suffix in ("", ".lock"))
    with lock.open("a") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        # The lock's file says that the folder is whole: a process that fails halfway leaves none that others trust. Its
        # size is asked for now, as another process may have filled the folder since this one opened the file.
        if os.fstat(held.fileno()).st_size == 0:
            folder.mkdir(exist_ok=True)
            fill(folder)
            held.write("filled\n")
    return folder


def computed_once(factory: pytest.TempPathFactory, name: str, compute: Callable[[], Value]) -> Value:
    """The pickled result of ``compute`` under ``name``, computed by whoever asks first in this run."""

    def fill(folder: Path) -> None:
        (folder / "value.pickle").write_bytes(pickle.dumps(compute()))

    value: Value = pickle.loads((folder_once(factory, name, fill) / "value.pickle").read_bytes())
    return value
