"""Setup links: a link in the log of a server makes its first token, so that nobody needs a shell where the server runs.

As long as the token table is empty, each start of a server writes one link to the log. A link is valid for an hour. The
first one that is used makes an administrator's token and ends all of them. The database stores only the hash of a link.
"""

from __future__ import annotations

import hmac
import secrets
import time
from collections.abc import Callable

import sqlalchemy as sql
from pydantic import SecretStr

from services.api.auth.audit import AuditedAction
from services.api.auth.tokens import IssuedToken, Scope, hash_of, insert_token, token_table
from services.client.errors import SetupLinkError
from services.core.settings import ServerSettings
from services.pipeline.database import metadata, writing

LIFETIME_S = 3600.0
"""Lifetime of a link in s: long enough to find it in the log, too short to be of use in an old log."""
NAME = "administrator"
"""Name of the token that a link makes."""

setup_link_table = sql.Table(
    "setup_link",
    metadata,
    sql.Column("sha256", sql.Text, primary_key=True),
    sql.Column("expires_s", sql.Float, nullable=False),
)


class SetupLinks:
    """The setup links of a database, shared by all its servers.

    Args:
        clock: Unix time.
    """

    def __init__(self, engine: sql.Engine, clock: Callable[[], float] = time.time) -> None:
        self._engine, self._clock = engine, clock

    def issue(self) -> SecretStr | None:
        """Create a link and return its secret; None where a token exists, whether that token is still valid or not."""
        secret = secrets.token_urlsafe(32)
        with writing(self._engine) as connection:
            if _has_token(connection):
                return None
            connection.execute(setup_link_table.delete().where(setup_link_table.c.expires_s <= self._clock()))
            connection.execute(
                setup_link_table.insert().values(sha256=hash_of(secret), expires_s=self._clock() + LIFETIME_S)
            )
        return SecretStr(secret)

    def redeem(self, secret: str, audited: AuditedAction) -> IssuedToken:
        """Create the administrator's token in exchange for a link; no link is valid afterwards.

        Raises:
            SetupLinkError: the link was used, has expired or is unknown, or a token exists already; the message does
                not say which.
        """
        presented = hash_of(secret)
        with writing(self._engine) as connection:
            stored_hashes = connection.scalars(
                sql.select(setup_link_table.c.sha256).where(setup_link_table.c.expires_s > self._clock())
            ).all()
            is_known = (
                sum(hmac.compare_digest(presented, one) for one in stored_hashes) > 0
            )  # every link is compared, so that the time taken discloses nothing
            if not is_known or _has_token(connection):
                what = "This setup link was used, has expired or is unknown"
                raise SetupLinkError(
                    f"{what}; restart the server for a new one, or, where there is a token already, ask its owner for"
                    " one."
                )
            connection.execute(setup_link_table.delete())
            return insert_token(connection, NAME, (Scope.ADMIN,), self._clock(), None, audited)


def setup_address(settings: ServerSettings, port: int) -> str:
    """Return the address of the page: the public URL, else the first further host name with TLS, else loopback on this
    machine.

    Args:
        port: port that the server listens on.
    """
    if settings.public_url is not None:
        return settings.public_url.rstrip("/")
    if first := settings.names.split(",")[0].strip():
        return f"https://{first}"
    return f"http://127.0.0.1:{port}"


def _has_token(connection: sql.Connection) -> bool:
    return connection.execute(sql.select(token_table.c.id).limit(1)).first() is not None
