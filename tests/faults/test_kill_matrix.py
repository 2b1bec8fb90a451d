"""Six cells of the kill matrix, one of every part and two of the capture; ``make faults`` runs all of them."""

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
]

pytestmark = pytest.mark.timeout(1800)


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SmallSystem]:
    with small_system(tmp_path_factory.mktemp("system")) as running:
        yield running


@pytest.mark.parametrize(("part", "stage", "point"), CELLS)
def test_a_kill_loses_nothing(system: SmallSystem, part: str, stage: str, point: str) -> None:
    assert run_cell(system, part, stage, point).faults == ()
