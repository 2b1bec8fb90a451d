"""Reads uploaded files in processes of bounded memory and time, so that no file can take those of the server.

The processes are started on demand and used again; one that takes too long or dies is replaced. See
``reading_process``.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from services.api.captures.descriptions import MAX_DESCRIPTION_BYTES, CaptureDescription
from services.client.errors import error_of
from services.core.errors import CaptureInputError, DentineError, PlatformError
from services.core.settings import UploadLimits

PROCESSES = 2
"""Number of processes that read side by side. A request that finds all of them at work waits."""
MAX_BYTES = 96 * 2**20
"""Memory in bytes of one process beyond the 45 MB that it has at its start. The description of five thousand images
under a thousand lights takes 37 MB."""
MAX_S = 60.0
"""Longest time in s for one file that is parsed, or for one batch of others. The largest file takes a second on a
machine that is not busy."""
MAX_ANSWER_BYTES = 4 * 2**20
"""Largest answer of a process in bytes: four times what the cameras and lights of the largest rig take."""
BATCH = 256
"""Number of files in one request, where only the headers of files are read."""
_PARSED = frozenset({".json", ".toml"})


class CostlyFileError(Exception):
    """A file could not be read within the bounds; the message is a sentence."""


class ReadingProcess:
    """One reading process, used by one thread at a time."""

    def __init__(self) -> None:
        # Pass on nothing of the server's environment, as it may hold a token or the password of the database.
        environment = {
            "PATH": os.defpath,
            "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            "PYTHONUTF8": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        command = [sys.executable, "-m", "services.api.captures.reading_process", str(MAX_BYTES)]
        self._process = subprocess.Popen(  # noqa: S603
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,
        )
        self.close = weakref.finalize(self, _end, self._process)
        """Ends the process, also when this object is no longer referenced."""

    def ask(self, request: dict[str, Any]) -> dict[str, Any] | None:
        """Send a request and return the answer; None where the process has died or taken too long, and is to be
        closed.
        """
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json.dumps(request).encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            return None
        line = self._read_line(time.monotonic() + MAX_S)
        return json.loads(line) if line is not None else None

    def _read_line(self, until: float) -> bytes | None:
        assert self._process.stdout is not None
        descriptor, line, poll = self._process.stdout.fileno(), bytearray(), select.poll()
        poll.register(descriptor, select.POLLIN)
        while not line.endswith(b"\n"):
            left_s = until - time.monotonic()
            if left_s <= 0 or len(line) > MAX_ANSWER_BYTES or not poll.poll(1000 * left_s):
                return None
            if not (piece := os.read(descriptor, 2**16)):
                return None
            line += piece
        return bytes(line)


class SubprocessReader:
    """A ``CaptureReader`` that reads in processes of bounded memory and time."""

    def __init__(self) -> None:
        self._slots, self._lock, self._idle = (
            threading.BoundedSemaphore(PROCESSES),
            threading.Lock(),
            list[ReadingProcess](),
        )
        self._is_closed = False

    def content_faults(
        self, files: Sequence[tuple[Path, str]], limits: UploadLimits, names: frozenset[str]
    ) -> Iterator[tuple[str, str]]:
        """Yield the names of faulty files and their faults; ends with the first file that cannot be read within the
        bounds.
        """
        parsed, others = list[tuple[Path, str]](), list[tuple[Path, str]]()
        for path, name in files:
            (parsed if Path(name).suffix.lower() in _PARSED else others).append((path, name))
        batches = [[one] for one in parsed] + [others[start : start + BATCH] for start in range(0, len(others), BATCH)]
        for batch in batches:
            (path, name), is_parsed = batch[0], len(batch) == 1 and batch[0] in parsed
            if is_parsed and (size := path.stat().st_size) > MAX_DESCRIPTION_BYTES:
                yield (
                    name,
                    (
                        f"{name} has {size} bytes and {MAX_DESCRIPTION_BYTES} are allowed of a description; leave out"
                        " what describes no image."
                    ),
                )
                continue
            paths = [(str(path), name) for path, name in batch]
            try:
                answer = self._ask(
                    {"files": paths, "limits": limits.model_dump(), "names": sorted(names) if is_parsed else []}, name
                )
            except CostlyFileError as problem:
                yield name, str(problem)
                return
            yield from (
                (name, fault) for (_, name), fault in zip(batch, answer["faults"], strict=True) if fault is not None
            )

    def describe(self, capture: Path) -> CaptureDescription:
        """Read the description of a capture; see ``descriptions``.

        Raises:
            CaptureInputError, CorruptStoreError: the description cannot be read, or not within the bounds.
        """
        try:
            return CaptureDescription.model_validate(self._ask({"capture": str(capture)}, str(capture))["described"])
        except CostlyFileError as problem:
            raise CaptureInputError(str(problem)) from problem

    def close(self) -> None:
        """End the idle processes; the others end after their current request."""
        with self._lock:
            self._is_closed, idle, self._idle = True, self._idle, []
        for one in idle:
            one.close()

    def _ask(self, request: dict[str, Any], name: str) -> dict[str, Any]:
        with self._slots:
            with self._lock:
                process = self._idle.pop() if self._idle else None
            began = time.monotonic()
            answer = process.ask(request) if process is not None else None
            if answer is None and time.monotonic() - began < MAX_S:  # none was idle, or the idle one had died
                if process is not None:
                    process.close()
                process = _start_process()
                answer = process.ask(request)
            assert process is not None
            with self._lock:
                is_reusable = answer is not None and not answer["is_last"] and not self._is_closed
                if is_reusable:
                    self._idle.append(process)
            if not is_reusable:
                process.close()
        if answer is None or "is_costly" in answer:
            bounds = f"{MAX_BYTES // 2**20} MiB of memory and {MAX_S:g} s"
            raise CostlyFileError(
                f"{name} cannot be read within {bounds}; make it smaller or simpler, or export it again."
            )
        if "code" in answer:
            raise error_of(answer["code"], answer["message"]) or DentineError(answer["message"])
        return answer


def _start_process() -> ReadingProcess:
    try:
        return ReadingProcess()
    except OSError as problem:
        raise PlatformError(
            f"The server cannot start a process to read the capture in ({problem.strerror}); free some memory and try"
            " again."
        ) from problem


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with suppress(OSError):
                pipe.close()
    process.wait()
