"""Tokens say who may call the API, and for what. The database holds their hashes; the token itself is shown once.

::

    dentine_<id>_<secret>     id: public, 48 bits, finds the row; secret: 256 random bits

A secret of 256 random bits needs no slow hash: nobody can find it from its SHA-256 by trying.
"""

from __future__ import annotations

import hashlib
import hmac
import math
import re
import secrets
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from typing import Annotated, Any, NamedTuple, Self

import sqlalchemy as sql
from pydantic import Field, SecretStr, WithJsonSchema, field_serializer

from services.api.auth.audit import AuditedAction
from services.api.auth.ended_sessions import EndedSessions
from services.client.errors import UnauthenticatedError, UnknownTokenError
from services.core.errors import InputError
from services.core.geometry import Record
from services.core.owners import LOCAL_VIEWER, Viewer, owner_of_token
from services.pipeline.database import Query, metadata, writing

TRUSTED_S = 1.0
"""Time in s for which a server trusts a token without looking it up again. A token that is revoked at this server ends
at once, at others within this time."""
MAX_TRUSTED = 1000
LAST_USE_STEP_S = 3600.0
"""Shortest time in s between two updates of the last use of a token, so that a request which only reads seldom
writes."""
DAY_S = 86400.0
NAME = "[A-Za-z0-9][A-Za-z0-9.-]{0,63}"
"""Pattern of a token's name."""
ID = "[0-9a-f]{12}"
"""Pattern of a token's id. No name matches it, so that a text means either an id or a name."""

token_table = sql.Table(
    "token",
    metadata,
    sql.Column("id", sql.Text, primary_key=True),
    sql.Column("name", sql.Text, nullable=False),
    sql.Column("scopes", sql.Text, nullable=False),
    sql.Column("sha256", sql.Text, nullable=False),
    sql.Column("created_s", sql.Float, nullable=False),
    sql.Column("expires_s", sql.Float),
    sql.Column("revoked_s", sql.Float),
    sql.Column("last_used_s", sql.Float),
    sql.Column("group", sql.Text),
)

_ONE = Query(sql.select(token_table).where(token_table.c.id == sql.bindparam("of")))


class Scope(StrEnum):
    """What a token may do. ``admin`` includes all, ``submit`` includes ``read``."""

    READ = "read"
    SUBMIT = "submit"
    OPERATE_DOME = "operate-dome"
    METRICS = "metrics"
    ADMIN = "admin"

    @property
    def included(self) -> frozenset[Scope]:
        """This scope and those that come with it."""
        return {Scope.ADMIN: frozenset(Scope), Scope.SUBMIT: frozenset({Scope.SUBMIT, Scope.READ})}.get(
            self, frozenset({self})
        )


class Token(Record):
    """A token as it may be shown at any time."""

    id: str = Field(description="public part of the token")
    name: str = Field(description="who or what uses it")
    scopes: tuple[Scope, ...]
    created_s: float = Field(description="Unix time")
    expires_s: float | None = Field(description="Unix time; null: never")
    revoked_s: float | None = Field(description="Unix time; null: not revoked")
    last_used_s: float | None = Field(description="Unix time, noted at most once an hour; null: never")
    group: str | None = Field(
        default=None, description="owns what its tokens make, and they see it; null: the token stands alone"
    )


class IssuedToken(Token):
    """A token on the one occasion when its secret is shown."""

    token: Annotated[SecretStr, WithJsonSchema({"type": "string"})] = Field(
        description="send it as 'Authorization: Bearer …'; it is not shown again"
    )

    @field_serializer("token", when_used="json")
    def _reveal(self, token: SecretStr) -> str:
        return token.get_secret_value()


@dataclass(frozen=True)
class Caller:
    """The caller of a request."""

    name: str
    scopes: frozenset[Scope]
    token: Token | None = None
    by_session: bool = False
    only_darkens: bool = False
    """Whether the caller has presented the dark key of a session, which may only darken the dome."""

    @cached_property
    def viewer(self) -> Viewer:
        """What the caller may see."""
        if self.token is None:
            return LOCAL_VIEWER
        return Viewer(
            self.token.group or owner_of_token(self.token.id),
            sees_all=Scope.ADMIN in self.scopes,
            uses_paths=Scope.SUBMIT in self.scopes,
        )

    @classmethod
    def of(cls, token: Token, *, by_session: bool = False, only_darkens: bool = False) -> Caller:
        """Return the caller that a valid token stands for."""
        scopes = frozenset[Scope]().union(*(scope.included for scope in token.scopes))
        return cls(token.name, scopes, token, by_session, only_darkens)


LOCAL = Caller("local", frozenset(Scope))
"""The caller of every request where access is open."""


class _Credential(NamedTuple):
    """Key of a trusted token: the hash of the token, or else the hash of a session's cookie or, without a session, the
    id of the token. The two are separate fields because an id is public and must never pass for a hash.
    """

    sha256: str | None
    session_of: str | None

    @classmethod
    def of(cls, presented: str | None = None, session_of: str | None = None) -> Self:
        return cls(None if presented is None else hash_of(presented), session_of)


class _TrustedToken(NamedTuple):
    """A token that was looked up, until when it is trusted (in ticks, s), and the number of revocations and ended
    sessions at this server before the look-up began. A later one makes it void.
    """

    token: Token
    until_ticks: float
    revocations: int


class Tokens:
    """The table of tokens.

    Args:
        clock: Unix time in s, by which tokens expire.
        ticks: time in s that is not affected by steps of the clock, by which trust ends.
    """

    def __init__(
        self, engine: sql.Engine, clock: Callable[[], float] = time.time, ticks: Callable[[], float] = time.monotonic
    ) -> None:
        self.engine, self._clock, self._ticks = engine, clock, ticks
        self.ended_sessions = EndedSessions(engine, clock)
        self._trusted: dict[_Credential, _TrustedToken] = {}
        self._revocations = 0

    def create(
        self,
        name: str,
        scopes: Iterable[Scope],
        expires_days: float | None,
        audited: AuditedAction,
        group: str | None = None,
    ) -> IssuedToken:
        """Create a token. Only the result holds its secret.

        Args:
            group: owner of the jobs and captures that the token makes; None: only the token itself and administrators
                see them.

        Raises:
            InputError: the name is malformed or belongs to a valid token, the name of the group is malformed, or no
                scope is given.
        """
        if not re.fullmatch(NAME, name) or name == LOCAL.name or re.fullmatch(ID, name):
            what = (
                f"use up to 64 letters, digits, points and hyphens, not '{LOCAL.name}' and nothing that looks like"
                " an id"
            )
            raise InputError(f"Token name {name!r} does not serve; {what}.")
        if group is not None and not re.fullmatch(NAME, group):
            raise InputError(
                f"Group {group!r} of token {name} does not serve; use up to 64 letters, digits, points and hyphens."
            )
        if not (requested_scopes := sorted(set(scopes))):
            raise InputError(f"Token {name} has no scope; give at least one of {', '.join(Scope)}.")
        now = self._clock()
        with writing(self.engine) as connection:
            namesake = sql.select(token_table).where(token_table.c.name == name, token_table.c.revoked_s.is_(None))
            if any(_is_valid(other, now) for other in connection.execute(namesake).mappings()):
                raise InputError(f"Token name {name!r} is in use; revoke that token or choose another name.")
            expires_s = None if expires_days is None else now + expires_days * DAY_S
            return insert_token(connection, name, requested_scopes, now, expires_s, audited, group)

    def list(self) -> list[Token]:
        """Return every token, newest first, with revoked and expired ones."""
        with self.engine.connect() as connection:
            return [
                Token(**_fields(row))
                for row in connection.execute(
                    sql.select(token_table).order_by(token_table.c.created_s.desc())
                ).mappings()
            ]

    def revoke(self, token_id: str, audited: AuditedAction) -> Token:
        """Revoke a token, named by its id or else by the name of one that is not revoked. Revoking it again changes
        nothing.

        Raises:
            UnknownTokenError: there is no such token.
        """
        now = self._clock()
        with writing(self.engine) as connection:
            is_named = sql.or_(
                token_table.c.id == token_id,
                sql.and_(token_table.c.name == token_id, token_table.c.revoked_s.is_(None)),
            )
            id_first = sql.case((token_table.c.id == token_id, 0), else_=1)
            found = (
                connection.execute(
                    sql.select(token_table).where(is_named).order_by(id_first, token_table.c.created_s.desc())
                )
                .mappings()
                .first()
            )
            if found is None:
                raise UnknownTokenError(f"There is no token {token_id}; list the tokens to see their ids.")
            row = dict(found)
            if row["revoked_s"] is None:
                row["revoked_s"] = now
                connection.execute(token_table.update().where(token_table.c.id == row["id"]).values(revoked_s=now))
            audited.ids["token_id"] = row["id"]
            audited.write(connection, 200)
        self._revocations += 1
        return Token(**_fields(row))

    def trusted(self, *, presented: str | None = None, session_of: str | None = None) -> Token | None:
        """Return the token that ``authenticate`` has found for ``presented``, or ``authenticate_session`` for
        ``session_of``, if it is still trusted, else None. The database is not asked.
        """
        found = self._trusted.get(_Credential.of(presented, session_of))
        return (
            found.token
            if found is not None and self._ticks() < found.until_ticks and found.revocations == self._revocations
            else None
        )

    def authenticate(self, presented: str) -> Token:
        """Look up the token that was presented.

        Raises:
            UnauthenticatedError: the token is malformed, unknown, expired or revoked; the message does not say which.
        """
        revocations, row = self._revocations, self._find(public_id(presented) or "")
        is_same = hmac.compare_digest(hash_of(presented), row["sha256"] if row else hash_of(""))
        if row is None or not is_same or not _is_valid(row, self._clock()):
            raise UnauthenticatedError("This token is unknown, expired or revoked; ask an administrator for a new one.")
        self._note_use(row)
        return self._remember(_Credential.of(presented), row, revocations)

    def end_session(self, sha256: str, expires_s: float) -> None:
        """End a session: at this server with the next request, at others within ``TRUSTED_S``."""
        self.ended_sessions.add(sha256, expires_s)
        self._revocations += 1

    def authenticate_session(self, token_id: str, session: str | None = None) -> Token:
        """Look up the valid token with this id, for a session that was opened with it.

        Args:
            session: SHA-256 of the claim of the session's cookie.

        Raises:
            UnauthenticatedError: the token has expired or was revoked, or the session was ended.
        """
        revocations, row = self._revocations, self._find(token_id)
        if session is not None and self.ended_sessions.has(session):
            raise UnauthenticatedError("This session was ended; sign in again with a token.")
        if row is None or not _is_valid(row, self._clock()):
            raise UnauthenticatedError(
                "The token of this session has expired or was revoked; sign in with another one."
            )
        return self._remember(_Credential.of(session_of=session or token_id), row, revocations)

    def _remember(self, credential: _Credential, row: Any, revocations: int) -> Token:
        token = Token(**_fields(row))
        remaining_s = math.inf if token.expires_s is None else token.expires_s - self._clock()
        if len(self._trusted) >= MAX_TRUSTED:
            self._trusted.clear()
        self._trusted[credential] = _TrustedToken(token, self._ticks() + min(TRUSTED_S, remaining_s), revocations)
        return token

    def _find(self, token_id: str) -> Any:
        rows = _ONE.rows(self.engine, of=token_id)
        return dict(zip(token_table.c.keys(), rows[0], strict=True)) if rows else None

    def _note_use(self, row: Any) -> None:
        now = self._clock()
        if row["last_used_s"] is None or now - row["last_used_s"] >= LAST_USE_STEP_S:
            with (
                suppress(sql.exc.OperationalError),
                writing(self.engine) as connection,
            ):  # a full disk must not make a request fail that only reads
                connection.execute(token_table.update().where(token_table.c.id == row["id"]).values(last_used_s=now))


def insert_token(
    connection: sql.Connection,
    name: str,
    scopes: Iterable[Scope],
    now_s: float,
    expires_s: float | None,
    audited: AuditedAction,
    group: str | None = None,
) -> IssuedToken:
    """Insert a token and its audit row inside the caller's transaction."""
    token_id = secrets.token_hex(6)
    secret = SecretStr(f"dentine_{token_id}_{secrets.token_urlsafe(32)}")
    row = {
        "id": token_id,
        "name": name,
        "scopes": " ".join(scopes),
        "sha256": hash_of(secret.get_secret_value()),
        "created_s": now_s,
    }
    row |= {"expires_s": expires_s, "revoked_s": None, "last_used_s": None, "group": group}
    connection.execute(token_table.insert().values(row))
    audited.ids["token_id"] = token_id
    audited.write(connection, 201)
    return IssuedToken(**_fields(row), token=secret)


def public_id(credential: str) -> str | None:
    """Return the id within a token, session cookie or dark key, whether that is valid or not; None if it is
    malformed.
    """
    match = re.match(r"(?:dentine|dark)_([0-9a-f]{12})_", credential)
    return match[1] if match else None


def hash_of(secret: str) -> str:
    """SHA-256 of a secret, hexadecimal; the database holds no secret itself."""
    return hashlib.sha256(secret.encode("utf-8", "surrogateescape")).hexdigest()


def _is_valid(row: Any, now: float) -> bool:
    return row["revoked_s"] is None and (row["expires_s"] is None or now < row["expires_s"])


def _fields(row: Any) -> dict[str, Any]:
    return {name: row[name] for name in Token.model_fields} | {
        "scopes": tuple(Scope(name) for name in row["scopes"].split())
    }
