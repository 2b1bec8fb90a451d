"""Some files mutated from good ones: read as by a second parser, or refused in a sentence.

``python -m tests.benchmarks.mutated_files`` tries more.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.mutated_files import FORMATS, outcomes


@pytest.mark.parametrize("name", FORMATS)
def test_no_mutated_file_is_read_wrongly_in_silence(name: str, tmp_path: Path) -> None:
    found = outcomes(name, 30, 5, tmp_path)
    assert [one for one in found if one.is_fault] == []
    kinds = {one.kind for one in found}
    assert {"same", "refused"} <= kinds, "some files are read, and some are refused"
