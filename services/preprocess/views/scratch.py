"""Arrays that the tasks of one preparation share, as files that are either complete or absent."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

A = TypeVar("A", bound=np.generic)


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as ``.npy`` atomically, so that a reader never sees a part of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    with partial.open("xb") as stream:
        np.save(stream, array)
    partial.replace(path)


def cached_array(path: Path | None, make: Callable[[], NDArray[A]]) -> NDArray[A]:
    """Memory-map the array in a file; if the file does not exist, make the array and write it first.

    Args:
        path: the ``.npy`` file; None to make the array each time and write nothing.
        make: computes the array.
    """
    if path is None:
        return make()
    if not path.exists():
        write_array(path, make())
    return np.asarray(np.load(path, mmap_mode="r"))
