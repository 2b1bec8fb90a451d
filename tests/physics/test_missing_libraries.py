"""If the machine lacks a system library that the renderer's wheels need, every entry to the renderer fails with one
sentence that names it.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SENTENCE = "The renderer needs libatomib.so.1, which this machine lacks; install the package of libatomib.so.1."
ENTRIES = {
    "check": ["-m", "services.transport.platform"],
    "phantom": ["-m", "services", "phantom", "--out", "mouth", "--samples", "16"],
    "slab": ["-m", "services", "simulate", "slab", "--alpha", "0.9", "--sigma", "1", "--width", "1"],
}


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a copy of the installed Dr.Jit that requires a system library of a name that no system has."""
    spec = importlib.util.find_spec("drjit")
    assert spec is not None
    assert spec.submodule_search_locations is not None
    installed = Path(spec.submodule_search_locations[0])
    folder = tmp_path_factory.mktemp("packages")
    shutil.copytree(installed, folder / "drjit", ignore=shutil.ignore_patterns("include", "cmake", "__pycache__"))
    library = folder / "drjit" / "libnanothread.so"
    asked = library.read_bytes()
    assert b"libatomic.so.1" in asked
    library.write_bytes(asked.replace(b"libatomic.so.1", b"libatomib.so.1"))
    return folder


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_missing_library_is_told_as_one_sentence(entry: str, packages: Path, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(packages), str(ROOT)))}
    told = subprocess.run(
        [sys.executable, *ENTRIES[entry]], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert (told.returncode, told.stdout) == (4, "")
    assert told.stderr.removeprefix("dentine: ") == SENTENCE + "\n"


def test_the_package_of_the_library_that_a_bare_debian_lacks_is_named(packages: Path, tmp_path: Path) -> None:
    code = """
import services.transport.platform as platform
platform.PACKAGES = {"libatomib.so.1": platform.PACKAGES["libatomic.so.1"]}
platform.prepare_device()
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(packages), str(ROOT)))}
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert told.stderr.splitlines()[-1].endswith("which this machine lacks; install libatomic1.")
