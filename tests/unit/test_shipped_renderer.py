"""The program that is shipped with an asset writes its picture on a machine with one core, too."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from services.assets.mitsuba import shipped

PROGRAM = """
import os, runpy, sys
from pathlib import Path
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # Mitsuba then has one thread
import drjit, mitsuba, numpy
mitsuba.set_variant("scalar_rgb")
assert drjit.thread_count() == 1
runpy.run_path(sys.argv[1])["write_image"](numpy.full((3, 5, 3), 0.25), Path(sys.argv[2]))
print(numpy.array(mitsuba.Bitmap(sys.argv[2])).mean())
"""


def test_a_picture_is_written_on_one_core(tmp_path: Path) -> None:
    script = Path(str(shipped.__path__[0])) / "render.py"
    told = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(script), str(tmp_path / "tooth.exr")],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert told.stdout == "0.25\n"
