"""The project's own words for what a record's validation finds; no wording of the library that validates reaches a
person.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, get_args

from pydantic_core.core_schema import ErrorType

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_OWN = frozenset({"value_error", "assertion_error"})
"""Types of the errors whose message a validator of this project has written."""
_PLACE = re.compile(r"line (\d+) column (\d+)")


def words_of(error: ErrorDetails) -> str:
    """What is wrong with a value, as the end of a sentence without its full stop; a remedy follows a semicolon where
    there is one to name.
    """
    kind = error["type"]
    if kind in _OWN:
        return error["msg"].partition(", ")[2] or error["msg"]
    if (written := _WORDS.get(kind)) is not None:
        return written if isinstance(written, str) else written(error.get("ctx", {}), error.get("input"))
    if kind not in library_kinds():
        return error["msg"]  # of a validator of this project, which gave it a name of its own
    family = (words for beginning, words in _FAMILIES.items() if kind.startswith(beginning))
    return next(family, "must be another value")


def library_kinds() -> frozenset[str]:
    """Names of the errors that the library can find by itself."""
    return frozenset(get_args(ErrorType))


def _text(_: Mapping[str, Any], given: Any) -> str:
    if isinstance(given, int | float) and not isinstance(given, bool):
        return f'must be a text; write "{given}" in quotes'
    return "must be a text; write it in quotes"


def _few(limits: Mapping[str, Any], _: Any) -> str:
    return f"has {_count(limits['actual_length'])} and needs at least {limits['min_length']}"


def _many(limits: Mapping[str, Any], _: Any) -> str:
    actual = limits.get("actual_length")
    return f"has {'more' if actual is None else _count(actual)} and may have {limits['max_length']}"


def _count(number: Any) -> str:
    return f"{number} {'entry' if number == 1 else 'entries'}"


def _short(limits: Mapping[str, Any], _: Any) -> str:
    least = int(limits["min_length"])
    return "is empty; give a text" if least == 1 else f"must have at least {least} characters"


def _json(limits: Mapping[str, Any], _: Any) -> str:
    place = _PLACE.search(str(limits.get("error", "")))
    where = f" at line {place[1]}, column {place[2]}" if place else ""
    return f"is not valid JSON{where}; correct it there, or export it again"


_Words = str | Callable[[Mapping[str, Any], Any], str]
_WORDS: Mapping[str, _Words] = MappingProxyType(
    {
        "string_type": _text,
        "string_sub_type": _text,
        "string_unicode": _text,
        "missing": "is missing; add it",
        "extra_forbidden": "is an unknown key; remove it",
        "none_required": "must be null; leave it out",
        "literal_error": lambda limits, _: f"must be {limits['expected']}",
        "enum": lambda limits, _: f"must be {limits['expected']}",
        "greater_than": lambda limits, _: f"must be greater than {limits['gt']:g}",
        "greater_than_equal": lambda limits, _: f"must be {limits['ge']:g} or more",
        "less_than": lambda limits, _: f"must be less than {limits['lt']:g}",
        "less_than_equal": lambda limits, _: f"must be {limits['le']:g} or less",
        "multiple_of": lambda limits, _: f"must be a multiple of {limits['multiple_of']:g}",
        "finite_number": "must be a finite number",
        "too_short": _few,
        "too_long": _many,
        "string_too_short": _short,
        "string_too_long": lambda limits, _: f"may have {limits['max_length']} characters at most",
        "string_pattern_mismatch": lambda limits, _: f"must have the form {limits['pattern']}",
        "json_invalid": _json,
        "recursion_loop": "is nested in itself; give a plain value",
        "union_tag_invalid": lambda limits, _: f"must be one of {limits['expected_tags']}",
    }
)
_FAMILIES: Mapping[str, str] = MappingProxyType(
    {
        "int": "must be a whole number",
        "float": "must be a number",
        "decimal": "must be a number",
        "complex": "must be a number",
        "bool": "must be true or false",
        "list": "must be a list in brackets",
        "tuple": "must be a list in brackets",
        "set": "must be a list in brackets",
        "frozen_set": "must be a list in brackets",
        "iterable": "must be a list in brackets",
        "arguments": "must be a list in brackets",
        "dict": "must be a table of keys and values",
        "mapping": "must be a table of keys and values",
        "model": "must be a table of keys and values",
        "dataclass": "must be a table of keys and values",
        "datetime": "must be a date and time such as 2026-01-31T12:00:00Z",
        "timezone": "must be a date and time such as 2026-01-31T12:00:00Z",
        "date": "must be a date such as 2026-01-31",
        "time_delta": "must be a span of time in seconds",
        "time": "must be a time such as 12:00:00",
        "url": "must be an address such as https://example.org/path",
        "uuid": "must be an identifier of 32 hexadecimal digits",
        "bytes": "must be a text; write it in quotes",
        "json": "must be a text of JSON",
        "path": "must be a path; write it in quotes",
    }
)
"""Beginnings of the names of the library's errors about one kind of value."""
