"""Reads JSON that a person or another program wrote, without guessing what an ambiguous text means."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NoReturn


class AmbiguousJsonError(ValueError):
    """A JSON text that parsers read in different ways."""


def _any_number(_members: list[tuple[str, Any]]) -> None:
    """Accept an object of any number of members."""


def parse_json(content: bytes | str, check: Callable[[list[tuple[str, Any]]], None] = _any_number) -> Any:
    """Parse JSON.

    Args:
        check: called with the members of each object; an error that it raises ends the parsing.

    Raises:
        AmbiguousJsonError: an object has two equal keys, of which other parsers silently take the last, or a value is
            NaN or Infinity, which JSON does not have. ValueError, RecursionError: it is no JSON, or nested too deeply.
    """

    def members_of(members: list[tuple[str, Any]]) -> dict[str, Any]:
        check(members)
        made = dict(members)
        if len(made) < len(members):
            keys = [key for key, _ in members]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise AmbiguousJsonError(f"key '{twice}' is given twice in one object; give it once")
        return made

    return json.loads(content, object_pairs_hook=members_of, parse_constant=_refuse_constant)


def _refuse_constant(name: str) -> NoReturn:
    raise AmbiguousJsonError(f"{name} is no number of JSON; give a finite number, or null where that is allowed")
