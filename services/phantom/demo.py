"""The mouth of the demonstration: a virtual incisor, rendered once in a child process and kept for later jobs."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType

from services.core.errors import CrashError
from services.core.store import write_atomic

OPTIONS: Mapping[str, str] = MappingProxyType({"pixel-mm": "0.5", "cameras": "3", "lights": "8", "samples": "8192"})
"""Options of ``dentine phantom``. With this number of samples the noise of the images is 3 %, and the held-out error is
the same; a quarter of the samples gives 6 %."""
NAME = "incisor-" + "-".join(f"{value}-{name}" for name, value in OPTIONS.items())
"""Name of this mouth's folder among the kept ones; it contains the options, so other options give another folder."""
WATCH_S = 0.25
"""Interval at which the rendering process is checked, seconds."""
DESCRIPTION = "capture.json"
"""Name of the file that is written last, so a folder that contains it is complete."""


def make_demo_mouth(folder: Path, kept_in: Path | None, look: Callable[[float], None]) -> bool:
    """Fill a folder with the mouth, and return whether it had to be rendered.

    Args:
        folder: folder to fill.
        kept_in: folder of mouths that were made earlier; None to keep none.
        look: called several times a second with the fraction done; an exception from it ends the rendering.

    Raises:
        CrashError: the rendering process failed; the message ends with the last line of its output.
    """
    kept = None if kept_in is None else kept_in / NAME
    if kept is not None and (kept / DESCRIPTION).is_file():
        shutil.copytree(kept, folder, dirs_exist_ok=True)
        return False
    _render(folder, look)
    if kept is not None:
        _keep(folder, kept)
    return True


def _render(folder: Path, look: Callable[[float], None]) -> None:
    # Render in a child process, because a kernel may hold the interpreter for seconds, during which the worker must
    # answer its scheduler, and because a process can be ended during a kernel.
    options = [part for name, value in OPTIONS.items() for part in (f"--{name}", value)]
    command = [sys.executable, "-m", "services", "phantom", "--out", str(folder), *options]
    words = folder.with_name(f"{folder.name}.words")
    images = int(OPTIONS["cameras"]) * int(OPTIONS["lights"])
    try:
        with words.open("wb") as said, subprocess.Popen(command, stdout=said, stderr=said) as process:  # noqa: S603
            try:
                while process.poll() is None:
                    look(len(list(folder.glob("*_var.npy"))) / images)
                    time.sleep(WATCH_S)
            finally:
                process.kill()
        if process.returncode:
            last = (words.read_text(errors="replace").strip().splitlines() or ["nothing"])[-1].removeprefix("dentine: ")
            raise CrashError(
                f"The demonstration's mouth could not be rendered: {last}", {"exit_status": process.returncode}
            )
    finally:
        words.unlink(missing_ok=True)


def _keep(folder: Path, kept: Path) -> None:
    # Publish by a rename, so that other jobs see either the whole mouth or nothing. If two jobs rendered it, the
    # rename of the slower one fails and is ignored.
    draft = kept.with_name(f".{kept.name}.{folder.parent.name}")
    shutil.rmtree(draft, ignore_errors=True)
    shutil.copytree(folder, draft)
    write_atomic(draft / DESCRIPTION, (folder / DESCRIPTION).read_bytes())
    with suppress(OSError):
        draft.rename(kept)
    shutil.rmtree(draft, ignore_errors=True)
