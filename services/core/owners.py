"""Who owns what is stored, and who may see it: a group, or else the one token that made it.

An owner is one text that never changes: the name of a group, or ``token:ID`` for a token without one.
"""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_GROUP = "default"
"""Owns what a server without tokens makes, and what versions before 0.2 have made; their tokens belong to it."""


def owner_of_token(token_id: str) -> str:
    """The owner that a token without a group is; no group has such a name."""
    return f"token:{token_id}"


@dataclass(frozen=True)
class Viewer:
    """Whoever asks, as far as it decides what is shown to him."""

    owner: str
    """Of what he makes."""
    sees_all: bool = False
    """Whether he may see and use what others own: an administrator, or anybody where no tokens are asked for."""
    uses_paths: bool = True
    """Whether he may submit, and so may see where on the server captures lie."""

    def may_see(self, owner: str | None) -> bool:
        """Whether something of this owner is shown; None: it is not there."""
        return self.sees_all or owner == self.owner

    def key(self, key: str | None) -> str | None:
        """An idempotency key as it is stored: two owners may choose the same."""
        return None if key is None else f"{self.owner}/{key}"


LOCAL_VIEWER = Viewer(DEFAULT_GROUP, sees_all=True)
"""Whoever is on this machine: the server itself, and callers where access is open."""
