"""What the parts of an object are called; a fit treats its body as a tooth's enamel, and its core as dentin."""

from __future__ import annotations

import re
from collections.abc import Mapping
from types import MappingProxyType
from typing import TypeVar

Value = TypeVar("Value")
PARTS: Mapping[str, str] = MappingProxyType({"enamel": "body", "dentin": "core"})
"""Part of a tooth -> part of an object with the same place in a fit."""
_PHRASES = (
    (r" In virtual mouths with such errors[^.]*\.", ""),
    (r"Teeth (are|under)", r"Objects \1"),
    (r"The teeth span", "The object spans"),
    (r"the teeth's centre, inside their", "the object's centre, inside its"),
    (r"(N|n)o tooth projects into", r"\1o part of the object projects into"),
    (r"no tooth is above", "nothing of the object is above"),
    (r"valid tooth pixel", "valid pixel of the object"),
    (r"pixel of tooth 0", "pixel of the object"),
    (r"all but the tooth's", "all but the object's"),
    (r"tooth 0\b", "the object"),
    (r"the mesh of the object", "the object's mesh"),
    (r"\btooth\b", "object"),
    (r"\bteeth\b", "object"),
)
"""Phrases about teeth, as patterns, and about an object; the first that fits holds."""


def part_of_an_object(name: str) -> str:
    """Name of an object's parameter: ``body.sigma`` for ``enamel.sigma``; others stay."""
    part, _, leaf = name.partition(".")
    return f"{PARTS[part]}.{leaf}" if part in PARTS else name


def part_of_a_tooth(name: str) -> str:
    """The inverse: ``enamel.sigma`` for ``body.sigma``."""
    part, _, leaf = name.partition(".")
    return next((f"{old}.{leaf}" for old, new in PARTS.items() if new == part), name)


def renamed(table: Mapping[str, Value]) -> dict[str, Value]:
    """A table by parameters with the names of an object's."""
    return {part_of_an_object(name): value for name, value in table.items()}


def of_an_object(text: str) -> str:
    """A sentence about a tooth in words about an object."""
    for pattern, words in _PHRASES:
        text = re.sub(pattern, words, text)
    for old, new in PARTS.items():
        text = re.sub(rf"\b{old}\b", new, text)
    return text
