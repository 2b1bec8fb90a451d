"""What the tasks of one preparation leave to each other, as files that are there whole or not at all."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

A = TypeVar("A", bound=np.generic)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as ``.npy``; whoever reads sees it whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    with partial.open("xb") as stream:
        np.save(stream, array)
    partial.replace(path)


def kept_array(path: Path | None, make: Callable[[], NDArray[A]]) -> NDArray[A]:
    """The array of a file, mapped from the disk; where there is none yet it is made and left there for others.

    Args:
        path: None to make it each time.
    """
    if path is None:
        return make()
    if not path.exists():
        write_array(path, make())
    return np.asarray(np.load(path, mmap_mode="r"))
