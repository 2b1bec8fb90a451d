"""Reads files that others have written: ``python -m services.api.captures.reading_process BYTES``.

``BYTES`` is the memory that it may take beyond that at its start. Requests and answers are lines of JSON. Whatever a
file causes ends with this process: too much memory, too much time, a fault in a parser. The process can write to no
file and leaves no core dump.
"""

from __future__ import annotations

import contextlib
import json
import resource
import sys
from pathlib import Path
from typing import Any

import numpy.lib.format  # noqa: F401 - so that it is not imported within the bounds

from services.api.captures.contents import content_fault
from services.api.captures.descriptions import describe
from services.core.errors import DentineError
from services.core.settings import UploadLimits

GROWN_BYTES = 64 * 2**20
"""Growth in bytes of the memory since the start beyond which the process ends after its answer, because the memory of
what was parsed stays with the process."""


def main(max_bytes: int) -> None:
    """Answer requests until the pipe is closed, or the memory has grown by ``GROWN_BYTES``."""
    _bound(max_bytes)
    start_bytes = _peak_bytes()
    for line in sys.stdin.buffer:
        answer = _answer(json.loads(line))
        is_last = _peak_bytes() - start_bytes > GROWN_BYTES
        print(json.dumps(answer | {"is_last": is_last}), flush=True)
        if is_last:
            return


def _answer(request: dict[str, Any]) -> dict[str, Any]:
    try:
        if "capture" in request:
            return {"described": describe(Path(request["capture"])).model_dump(mode="json")}
        limits, names = UploadLimits.model_validate(request["limits"]), frozenset(request["names"])
        return {"faults": [content_fault(Path(path), name, limits, names) for path, name in request["files"]]}
    except DentineError as problem:
        return {"code": problem.code, "message": problem.message}
    except MemoryError:
        return {"is_costly": True}
    except OSError as problem:
        return {
            "code": DentineError.code,
            "message": f"{problem.filename or 'A file'} cannot be read ({problem.strerror}); check the server's disk.",
        }


def _bound(max_bytes: int) -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    bounds = {
        resource.RLIMIT_AS: pages * resource.getpagesize() + max_bytes,
        resource.RLIMIT_CORE: 0,
        resource.RLIMIT_FSIZE: 0,
    }
    for kind, bound in bounds.items():
        with contextlib.suppress(OSError, ValueError):  # a bound that is lower already
            resource.setrlimit(kind, (bound, bound))


def _peak_bytes() -> int:
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


if __name__ == "__main__":
    main(int(sys.argv[1]))
