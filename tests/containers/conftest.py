"""A composed system for the tests of this folder, and small captures to submit to it."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.containers.composed_system import ROOT, USER, ComposedSystem
from tests.support.store_disk import StoreDisk

DISK_BYTES = 4 * 2**30


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "tests/containers" in str(item.path):
            item.add_marker(pytest.mark.containers)
            item.add_marker(pytest.mark.slow)
            item.add_marker(pytest.mark.timeout(3600))


@pytest.fixture(scope="session")
def figures() -> Iterator[dict[str, object]]:
    """Figures that the tests measure; at the end they are written to the file that ``DENTINE_FIGURES`` names."""
    measured: dict[str, object] = {}
    yield measured
    if file := os.environ.get("DENTINE_FIGURES"):
        Path(file).write_text(json.dumps(measured, indent=1) + "\n")


@pytest.fixture(scope="session")
def disk(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StoreDisk]:
    if os.geteuid() != 0:
        pytest.skip("Only the superuser mounts the disk that these tests fill.")
    disk = StoreDisk(tmp_path_factory.mktemp("composed") / "data", DISK_BYTES)
    disk.open()
    os.chown(disk.folder, USER, USER)
    yield disk
    disk.close()


@pytest.fixture(scope="session")
def system(disk: StoreDisk, figures: dict[str, object]) -> Iterator[ComposedSystem]:
    """A running system; ``make deploy-test`` builds its images beforehand."""
    system = ComposedSystem("dentinetest", disk.folder)
    try:
        system.engine("info")
    except (AssertionError, FileNotFoundError):
        pytest.skip("No container engine answers.")
    figures["up_to_ready_s"] = round(system.up(), 1)
    yield system
    if "DENTINE_KEEP" not in os.environ:
        system.down("--volumes", "--timeout", "20")


@pytest.fixture(scope="session")
def token(system: ComposedSystem) -> str:
    return system.token("tests", "admin")


@pytest.fixture(scope="session")
def mouth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A phantom of ten by fourteen pixels."""
    folder = tmp_path_factory.mktemp("captures") / "mouth"
    size = ["--pixel-mm", "1.5", "--cameras", "1", "--lights", "4", "--samples", "64"]
    subprocess.run([str(ROOT / ".venv/bin/dentine"), "phantom", "--out", str(folder), *size], check=True)
    return folder
