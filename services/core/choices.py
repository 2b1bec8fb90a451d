"""Choosing by name, where a name that is not known must not pass for another."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeVar

from services.core.errors import SettingsError

T = TypeVar("T")


def chosen(what: str, name: str, choices: Mapping[str, T]) -> T:
    """What a name stands for.

    Args:
        what: the thing that is chosen, as the message shall call it.

    Raises:
        SettingsError: nothing has that name; the message lists the names that there are.
    """
    if name not in choices:
        raise SettingsError(f"{what} {name!r} is not known; known are {', '.join(sorted(choices))}.")
    return choices[name]
