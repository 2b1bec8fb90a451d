"""Eight cells of the fault matrix: kills of every part, two of them in the capture, and two faults that need no network
or disk of their own. ``make faults`` runs all cells.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.faults.kill_matrix import run_cell
from tests.support.small_system import SmallSystem, small_system

CELLS = [
    ("api", "fit", "middle"),
    ("scheduler", "prepare", "end"),
    ("stage", "capture", "middle"),
    ("host", "fit", "start"),
    ("database", "capture", "start"),
    ("database", "export", "end"),
    ("clock back", "prepare", "middle"),
    ("submitted again", "fit", "middle"),
]

pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SmallSystem]:
    with small_system(tmp_path_factory.mktemp("system")) as running:
        yield running


@pytest.mark.dear("A whole service is started, struck and started again.")
@pytest.mark.parametrize(("fault", "stage", "point"), CELLS)
def test_a_fault_loses_nothing(system: SmallSystem, fault: str, stage: str, point: str) -> None:
    assert run_cell(system, fault, stage, point).faults == ()
