"""Who owns what is stored, and who may see it: a group, or else the one token that made it.

An owner is one text that never changes: the name of a group, or ``token:ID`` for a token without one.
"""

from __future__ import annotations

from dataclasses import dataclass

DEFAULT_GROUP = "default"
"""Group that owns everything made by a server without tokens and by versions before 0.2, whose tokens belong to it."""


def owner_of_token(token_id: str) -> str:
    """The owner that stands for a token without a group; no group has such a name."""
    return f"token:{token_id}"


@dataclass(frozen=True)
class Viewer:
    """The caller of a request, with the properties that decide what the caller may see."""

    owner: str
    """Owner of everything that the viewer makes."""
    sees_all: bool = False
    """Whether the viewer may see and use what others own, as administrators may, and anybody where no token is
    required."""
    uses_paths: bool = True
    """Whether the viewer may submit jobs, and therefore may see the paths of captures on the server."""

    def may_see(self, owner: str | None) -> bool:
        """Whether the viewer may see something that this owner owns; the owner is None where it does not exist."""
        return self.sees_all or owner == self.owner

    def key(self, key: str | None) -> str | None:
        """An idempotency key as it is stored: with the owner, because two owners may choose the same key."""
        return None if key is None else f"{self.owner}/{key}"


LOCAL_VIEWER = Viewer(DEFAULT_GROUP, sees_all=True)
"""The viewer for everybody on this machine: the server itself, and all callers where access is open."""
