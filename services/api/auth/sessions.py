"""Browser sessions: a signed cookie that stands for a token for some hours.

The server stores no sessions but those that were ended; see ``ended_sessions``. ::

    dentine_<token id>_<expiry, Unix s>_<random>.<HMAC-SHA256>     version 0.1 had no random part

    dark_<token id>_<expiry, Unix s>_<SHA-256 of the cookie's claim>.<HMAC-SHA256>     a session's dark key

A page cannot read its cookie, and a request with a cookie waits for one of the browser's six connections, which long
downloads may all occupy. A dark key, which can only darken the dome, is sent without the cookie, over a connection of
its own.

The signing key lies beside the database and not in it, so that a copy of the database opens no session.
"""

from __future__ import annotations

import hashlib
import hmac
import re
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from services.api.auth.tokens import Token
from services.client.errors import UnauthenticatedError
from services.core.files.private import write_private

COOKIE = "dentine-session"
KEY_FILE = "session.key"
DARK = "dark_"
"""Prefix of a dark key; no token has it."""
_KEY_BYTES = 32


@dataclass(frozen=True)
class Session:
    """The session that a valid cookie or dark key stands for."""

    token_id: str
    expires_s: float
    sha256: str
    """SHA-256 of the cookie's claim. It names the session without opening it."""


class Sessions:
    """Issues and reads session cookies and dark keys.

    Args:
        key: secret that signs them.
        lifetime_s: longest lifetime of a session, in s.
        clock: Unix time, in s.
    """

    def __init__(self, key: bytes, lifetime_s: float, clock: Callable[[], float] = time.time) -> None:
        self._key, self._lifetime_s, self._clock = key, lifetime_s, clock

    def issue(self, token: Token) -> tuple[str, int]:
        """Return the cookie of a new session for a valid token, and its lifetime in s; a session never outlives its
        token.
        """
        now = self._clock()
        expires_s = int(min(now + self._lifetime_s, token.expires_s or float("inf")))
        claim = f"dentine_{token.id}_{expires_s}_{secrets.token_hex(8)}"
        return f"{claim}.{self._sign(claim)}", max(0, expires_s - int(now))

    def read(self, cookie: str) -> Session:
        """Return the session that a cookie stands for.

        Raises:
            UnauthenticatedError: the cookie is not signed by this server, or the session is over.
        """
        claim, _, signature = cookie.rpartition(".")
        match = re.fullmatch(r"dentine_([0-9a-f]{12})_([0-9]{1,12})(_[0-9a-f]{16})?", claim)
        return self._signed(
            claim, signature, match, hashlib.sha256(claim.encode("utf-8", "surrogateescape")).hexdigest()
        )

    def dark_key(self, session: Session) -> str:
        """Return the dark key of a session, which can darken the dome for as long as the session lasts."""
        claim = f"{DARK}{session.token_id}_{session.expires_s:.0f}_{session.sha256}"
        return f"{claim}.{self._sign(claim)}"

    def read_dark_key(self, key: str) -> Session:
        """Return the session that a dark key belongs to.

        Raises:
            UnauthenticatedError: the key is not signed by this server, or the session is over.
        """
        claim, _, signature = key.rpartition(".")
        match = re.fullmatch(rf"{DARK}([0-9a-f]{{12}})_([0-9]{{1,12}})_([0-9a-f]{{64}})", claim)
        return self._signed(claim, signature, match, match[3] if match else "")

    def _signed(self, claim: str, signature: str, match: re.Match[str] | None, sha256: str) -> Session:
        is_ours = hmac.compare_digest(self._sign(claim).encode(), signature.encode("utf-8", "surrogateescape"))
        if match is None or not is_ours or self._clock() >= int(match[2]):
            raise UnauthenticatedError("This session is over; sign in again with a token.")
        return Session(match[1], float(match[2]), sha256)

    def _sign(self, claim: str) -> str:
        return hmac.new(self._key, claim.encode("utf-8", "surrogateescape"), hashlib.sha256).hexdigest()


def read_key(data: Path) -> bytes:
    """Return the signing key of a data folder. It is created on first use, readable by its owner alone."""
    path = data / KEY_FILE
    if not path.exists():
        write_private(path, secrets.token_bytes(_KEY_BYTES))
    return path.read_bytes()
