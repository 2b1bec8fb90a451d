"""What the tasks of one preparation leave to each other, as files that are there whole or not at all."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def write_array(path: Path, array: NDArray[Any]) -> None:
    """Write an array as ``.npy``; whoever reads sees it whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(8)}.partial")
    with partial.open("xb") as stream:
        np.save(stream, array)
    partial.replace(path)
