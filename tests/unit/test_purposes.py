"""Every kind of task that the fit traces has a purpose that the report names."""

from __future__ import annotations

import re
from pathlib import Path

import services.fit
from services.fit.stages.attempt import PURPOSES

KIND = re.compile(r'trace_row\(\s*"(\w+)"')


def test_every_kind_of_task_has_a_purpose() -> None:
    (folder,) = services.fit.__path__
    kinds = {kind for path in Path(folder).rglob("*.py") for kind in KIND.findall(path.read_text(encoding="utf-8"))}
    assert {"compare", "moves", "stain"} < kinds
    assert kinds == PURPOSES.keys()
