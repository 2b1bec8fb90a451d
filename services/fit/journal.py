"""Durable execution: what a fit has done is written down, and a new attempt reads it instead of doing it again.

The driver is a deterministic function. Each costly part runs as ``journal.once(key, compute)``; its JSON result is on disk before the next part starts.
A later attempt runs the same function, gets the recorded results back in the same order, and goes on where the record ends. Every part depends only on
recorded results and on seeds, so the answer of an interrupted fit is that of an undisturbed one.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from services.core.store import write_atomic

FORMAT_VERSION = 1


class Journal:
    """Results by key, in one file that is replaced atomically."""

    def __init__(self, path: Path, fingerprint: str, guard: Callable[[], None] = lambda: None) -> None:
        """Open or begin a journal.

        Args:
            fingerprint: identifies job and data; a journal of another one is not continued.
            guard: called before every write; raises when this attempt has lost the right to write.
        """
        self.path, self._fingerprint, self._guard = path, fingerprint, guard
        self.entries: dict[str, Any] = {}
        if path.is_file():
            stored = json.loads(path.read_text())
            if stored.get("format") == FORMAT_VERSION and stored.get("fingerprint") == fingerprint:
                self.entries = stored["entries"]
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
