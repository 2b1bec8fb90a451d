"""The text form of USD (``.usda``, OpenUSD 26): values and prims.

Text needs no library to write, and every program that reads USD reads it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

INDENT = "    "


def quoted(text: str) -> str:
    """A string; USD escapes quotes and backslashes as JSON does."""
    return json.dumps(text, ensure_ascii=False)


def number(value: float) -> str:
    """A number with the nine digits that single precision needs to come back unchanged."""
    return f"{value:.9g}"


def vector(values: Iterable[float]) -> str:
    """A tuple such as ``float3``."""
    return f"({', '.join(number(value) for value in values)})"


def array(values: ArrayLike) -> str:
    """An array of numbers (N,), or of tuples (N, K)."""
    stored: NDArray[np.generic] = np.asarray(values)
    if stored.ndim == 1:
        return f"[{', '.join(map(number if stored.dtype.kind == 'f' else str, stored.tolist()))}]"
    return f"[{', '.join(map(vector, stored.tolist()))}]"


def prim(kind: str, name: str, lines: Sequence[str], metadata: Sequence[str] = ()) -> list[str]:
    """Lines that define a prim: its metadata in parentheses, its attributes and children indented."""
    head = f"def {kind} {quoted(name)}"
    opening = [f"{head} (", *(INDENT + line for line in metadata), ")"] if metadata else [head]
    return [*opening, "{", *(INDENT + line for line in lines), "}"]
