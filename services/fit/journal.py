"""Durable execution: what a fit has done is written down, and a new attempt reads it instead of doing it again.

The driver is a deterministic function. Each costly part runs as ``journal.once(key, compute)``; its JSON result is on disk before the next part starts.
A later attempt runs the same function, gets the recorded results back in the same order, and goes on where the record ends. Every part depends only on
recorded results and on seeds, so the answer of an interrupted fit is that of an undisturbed one.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from services.core.store import write_atomic

FORMAT_VERSION = 1


class Journal:
    """Results by key, in one file that is replaced atomically.

    Attributes:
        resumed: how many results an earlier attempt left.
        set_aside: where a checkpoint that is not this fit's was moved, kept for its owner; None where there was none.
    """

    def __init__(self, path: Path, fingerprint: str, guard: Callable[[], None] = lambda: None) -> None:
        """Open or begin a journal.

        Args:
            fingerprint: identifies job, data and version; a journal of another one is set aside, neither continued nor lost.
            guard: called before every write; raises when this attempt has lost the right to write.
        """
        self.path, self._fingerprint, self._guard = path, fingerprint, guard
        self.entries: dict[str, Any] = {}
        self.set_aside: Path | None = None
        if path.is_file():
            stored = _read(path)
            if stored.get("format") == FORMAT_VERSION and stored.get("fingerprint") == fingerprint:
                self.entries = stored["entries"]
            else:
                guard()
                self.set_aside = _free_name(path)
                path.rename(self.set_aside)
        self.resumed = len(self.entries)

    def once(self, key: str, compute: Callable[[], Any]) -> tuple[Any, bool]:
        """The recorded result of ``key``, or compute, record and return it; the flag says whether it is new. Floats survive exactly."""
        if key in self.entries:
            return self.entries[key], False
        value = json.loads(json.dumps(compute(), allow_nan=False))
        self._guard()
        self.entries[key] = value
        content = {"format": FORMAT_VERSION, "fingerprint": self._fingerprint, "entries": self.entries}
        write_atomic(self.path, json.dumps(content).encode())
        return value, True


def _read(path: Path) -> dict[str, Any]:
    # A file that is no journal belongs to no fit.
    try:
        stored = json.loads(path.read_bytes())
    except ValueError:
        return {}
    return stored if isinstance(stored, dict) and isinstance(stored.get("entries"), dict) else {}


def _free_name(path: Path) -> Path:
    numbers = (path.with_stem(f"{path.stem}-set-aside-{k}") for k in itertools.count(1))
    return next(candidate for candidate in numbers if not candidate.exists())
