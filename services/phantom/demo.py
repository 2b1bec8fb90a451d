"""The mouth of the demonstration: a virtual incisor, rendered once in a child process and cached for later jobs."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType

from services.core.errors import CrashError
from services.core.store import write_atomic
from services.phantom import end_with_parent

OPTIONS: Mapping[str, str] = MappingProxyType(
    {"pixel-mm": "0.2", "cameras": "3", "lights": "8", "channels": "3", "samples": "512"}
)
"""Options of ``dentine phantom``. A pixel is small enough to show a tooth, and its noise is 12 %. The demonstration
fits squares of 3 × 3 pixels, whose noise is 4 %."""
NAME = "incisor-" + "-".join(f"{value}-{name}" for name, value in OPTIONS.items())
"""Name of this mouth's folder among the cached ones; it contains the options, so other options give another folder."""
CHECK_INTERVAL_S = 0.25
"""Interval at which the rendering process is checked, seconds."""
DESCRIPTION = "capture.json"
"""Name of the file that is written last, so a folder that contains it is complete."""


def make_demo_mouth(folder: Path, cache: Path | None, report_fraction: Callable[[float], None]) -> bool:
    """Fill a folder with the mouth, and return whether it had to be rendered.

    Args:
        folder: folder to fill.
        cache: folder of mouths that were made earlier; None to keep none.
        report_fraction: called several times a second with the fraction done; an exception from it ends the rendering.

    Raises:
        CrashError: the rendering process failed; the message ends with the last line of its output.
    """
    cached = None if cache is None else cache / NAME
    if cached is not None and (cached / DESCRIPTION).is_file():
        shutil.copytree(cached, folder, dirs_exist_ok=True)
        return False
    _render(folder, report_fraction)
    if cached is not None:
        _store_in_cache(folder, cached)
    return True


def _render(folder: Path, report_fraction: Callable[[float], None]) -> None:
    # Render in a child process, because a kernel may hold the interpreter for seconds, during which the worker must
    # answer its scheduler, and because a process can be ended during a kernel.
    options = [part for name, value in OPTIONS.items() for part in (f"--{name}", value)]
    command = end_with_parent.command("services", ["phantom", "--out", str(folder), *options])
    log = folder.with_name(f"{folder.name}.words")
    images = int(OPTIONS["cameras"]) * int(OPTIONS["lights"])
    try:
        with (
            log.open("wb") as stream,
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=stream, stderr=stream) as process,  # noqa: S603
        ):
            try:
                while process.poll() is None:
                    report_fraction(len(list(folder.glob("*_var.npy"))) / images)
                    time.sleep(CHECK_INTERVAL_S)
            finally:
                process.kill()
        if process.returncode:
            last = (log.read_text(errors="replace").strip().splitlines() or ["nothing"])[-1].removeprefix("dentine: ")
            raise CrashError(
                f"The demonstration's mouth could not be rendered: {last}", {"exit_status": process.returncode}
            )
    finally:
        log.unlink(missing_ok=True)


def _store_in_cache(folder: Path, cached: Path) -> None:
    # Publish by a rename, so that other jobs see either the whole mouth or nothing. If two jobs rendered it, the
    # rename of the slower one fails and is ignored.
    draft = cached.with_name(f".{cached.name}.{folder.parent.name}")
    shutil.rmtree(draft, ignore_errors=True)
    shutil.copytree(folder, draft)
    write_atomic(draft / DESCRIPTION, (folder / DESCRIPTION).read_bytes())
    with suppress(OSError):
        draft.rename(cached)
    shutil.rmtree(draft, ignore_errors=True)
