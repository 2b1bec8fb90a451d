"""The mouth of the demonstration: a virtual incisor, rendered once in a process of its own and kept for the jobs
after.
"""

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
"""Of ``dentine phantom``. With so many samples the images' own noise is 3 %, which is what the held-out error comes to;
a quarter of them gives 6 %."""
NAME = "incisor-" + "-".join(f"{value}-{name}" for name, value in OPTIONS.items())
"""Folder of this mouth among those that are kept: another one where the options change."""
WATCH_S = 0.25
DESCRIPTION = "capture.json"
"""Written last, so a folder that has it is whole."""


def make_demo_mouth(folder: Path, kept_in: Path | None, look: Callable[[float], None]) -> bool:
    """Fill a folder with the mouth; returns whether it had to be rendered.

    Args:
        kept_in: folder with mouths made earlier; None where none are kept.
        look: called with the fraction done, several times a second; what it raises ends the rendering.

    Raises:
        CrashError: the rendering process ended; the message ends with its last words.
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
    # As a process: a kernel may hold the interpreter for seconds, in which the worker must answer its scheduler; and it
    # can be ended in mid-kernel.
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
    # By a rename, so that another job sees all of it or none; the slower of two jobs that rendered it finds it there.
    draft = kept.with_name(f".{kept.name}.{folder.parent.name}")
    shutil.rmtree(draft, ignore_errors=True)
    shutil.copytree(folder, draft)
    write_atomic(draft / DESCRIPTION, (folder / DESCRIPTION).read_bytes())
    with suppress(OSError):
        draft.rename(kept)
    shutil.rmtree(draft, ignore_errors=True)
