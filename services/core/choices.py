"""Lookup of a choice by its name; an unknown name is an error and never stands for a default."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from services.core.errors import SettingsError

T = TypeVar("T")


def chosen(what: str, name: str, choices: Mapping[str, T]) -> T:
    """Return the choice of a given name.

    Args:
        what: word for the kind of choice, for the message.

    Raises:
        SettingsError: there is no choice of that name; the message lists the known names.
    """
    if name not in choices:
        raise SettingsError(f"{what} {name!r} is not known; known are {', '.join(sorted(choices))}.")
    return choices[name]
