"""Files of arrays that are named by their content: small enough for every worker to read, and without pickles."""

from __future__ import annotations

import hashlib
import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CorruptStoreError
from services.core.store import write_atomic

SMALL_BYTES = 2**18
"""Largest file whose arrays stay in memory, in bytes."""


@dataclass(frozen=True)
class StoredFile:
    """A file that is named by its content."""

    path: Path
    digest: str

    def load(self) -> dict[str, NDArray[np.generic]]:
        """The arrays in the file.

        Raises:
            CorruptStoreError: the file is missing or altered.
        """
        content = self.path.read_bytes() if self.path.is_file() else b""
        if _digest(content) != self.digest:
            raise CorruptStoreError(
                f"{self.path} is missing or altered; remove its folder so that the fit starts again."
            )
        return _small_arrays(content) if len(content) <= SMALL_BYTES else _arrays(content)


def _arrays(content: bytes) -> dict[str, NDArray[np.generic]]:
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


_small_arrays = lru_cache(maxsize=32)(_arrays)
"""The arrays of small files, which are read for every task and take longer to take apart than to check. They are
recognised by their whole content."""


def write_arrays(folder: Path, stem: str, **arrays: NDArray[Any]) -> StoredFile:
    """Store arrays in ``folder``, in a file named after ``stem`` and their digest; writing the same again changes
    nothing.
    """
    stream = io.BytesIO()
    np.savez(stream, allow_pickle=False, **arrays)
    content = stream.getvalue()
    digest = _digest(content)
    path = folder / f"{stem}-{digest[:16]}.npz"
    if not path.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, content)
    return StoredFile(path, digest)


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
