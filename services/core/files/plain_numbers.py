"""Validation that takes a number only where a number is given."""

from __future__ import annotations

from typing import Any

from pydantic_core import PydanticCustomError, core_schema

_UNCHANGED = frozenset({"keys_schema", "serialization", "metadata", "default", "ref", "config"})
"""Parts of a schema that hold no value of a number."""


def with_plain_numbers(schema: Any, record: type) -> Any:
    """Return a record's schema in which every number but the keys of its tables has to be given as a number. Records in
    it see to their own numbers.
    """
    if isinstance(schema, list | tuple):
        return type(schema)(with_plain_numbers(part, record) for part in schema)
    if not isinstance(schema, dict) or (schema.get("type") == "model" and schema["cls"] is not record):
        return schema
    changed = {name: _changed_part(name, part, record) for name, part in schema.items()}
    return (
        core_schema.no_info_before_validator_function(_plain_number, changed)
        if changed.get("type") in ("int", "float")
        else changed
    )


def _changed_part(name: str, part: Any, record: type) -> Any:
    if name in _UNCHANGED:
        return part
    if name == "fields" and isinstance(part, dict):  # by the names that a record gives them
        return {field: with_plain_numbers(one, record) for field, one in part.items()}
    return with_plain_numbers(part, record)


def _plain_number(value: Any) -> Any:
    if isinstance(value, bool | str):
        raise PydanticCustomError("number_type", "give a number, neither a text nor true or false")
    return value
