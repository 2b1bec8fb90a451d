"""A raw folder's description as text: TOML with plain values first, then tables, then lists of tables."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any


def description_toml(tree: Mapping[str, Any]) -> bytes:
    """Text of ``raw.toml``: values below the second level stand in one line, and those that are None are left out."""
    tables = {
        key: [(f"[{key}]", value)] if isinstance(value, dict) else [(f"[[{key}]]", one) for one in value]
        for key, value in tree.items()
        if isinstance(value, dict) or (isinstance(value, list) and all(isinstance(one, dict) for one in value))
    }
    lines = [f"{key} = {toml_value(value)}" for key, value in tree.items() if key not in tables]
    for entries in tables.values():
        for head, table in entries:
            lines += ["", head, *(f"{name} = {toml_value(one)}" for name, one in table.items() if one is not None)]
    return ("\n".join(lines) + "\n").encode()


def toml_value(value: Any) -> str:
    """The TOML of a value, in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {toml_value(one)}" for key, one in value.items()) + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    # JSON's strings, numbers and booleans are valid TOML too, except for the character DEL, which no name holds.
    return json.dumps(value, ensure_ascii=False)
