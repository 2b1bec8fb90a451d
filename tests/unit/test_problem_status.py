"""The HTTP status of an error is that of its class or of the nearest class above it, in whatever order the table lists
them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from services.api.http import problems
from services.api.http.problems import _STATUS, status_of
from services.core.errors import DentineError


def kinds_below(kind: type[DentineError]) -> list[type[DentineError]]:
    return [kind, *(one for below in kind.__subclasses__() for one in kinds_below(below))]


KINDS = kinds_below(DentineError)


@pytest.mark.parametrize("order", [list, reversed, lambda items: sorted(items, key=lambda item: item[0].__name__)])
def test_the_order_of_the_table_does_not_matter(order: Callable[[Any], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(KINDS) > 50
    monkeypatch.setattr(problems, "_STATUS", dict(order(list(_STATUS.items()))))
    for kind in KINDS:
        # No class has two parents, so the nearest one above is the first listed one on the way to the root.
        above = kind
        while above not in _STATUS:
            (above,) = above.__bases__
        assert status_of(kind("It is.")) == _STATUS[above], kind
