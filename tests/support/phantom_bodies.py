"""Phantom bodies that many tests look at, built once in a process. Nobody may change their arrays."""

from __future__ import annotations

from functools import cache

from services.anatomy.templates.jaw import Jaw, build_jaw


@cache
def phantom_jaw(seed: int | None) -> Jaw:
    """The upper jaw of a subject, or with None the average."""
    return build_jaw(seed)
