"""Access tokens: what is stored, who is admitted, and when a token ends."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sql

from services.api.auth import sessions, tokens
from services.api.auth.audit import AuditLog
from services.api.auth.sessions import Sessions, read_key
from services.api.auth.tokens import DAY_S, LAST_USE_STEP_S, Caller, Scope, Tokens, insert_token, token_table
from services.client.errors import UnauthenticatedError, UnknownTokenError
from services.core.errors import InputError
from services.core.redaction import redacted
from services.pipeline.database import open_database, writing
from tests.support.empty_database import empty_database
from tests.support.guarded_server import make_deed

NOON_S = 1_800_000_000.0


class Clock:
    """Unix time, and a monotonic clock that advances with it unless the time is stepped."""

    def __init__(self) -> None:
        self.now_s, self.stepped_s = NOON_S, 0.0

    def __call__(self) -> float:
        return self.now_s

    def ticks(self) -> float:
        return self.now_s - NOON_S - self.stepped_s

    def step(self, seconds: float) -> None:
        self.now_s += seconds
        self.stepped_s += seconds


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[sql.Engine]:
    engine = open_database(empty_database(tmp_path / "x.sqlite"))
    yield engine
    engine.dispose()


@pytest.fixture
def table(engine: sql.Engine, clock: Clock) -> Tokens:
    return Tokens(engine, clock, clock.ticks)


def issue(
    table: Tokens, name: str = "rig-1", scopes: tuple[Scope, ...] = (Scope.READ,), days: float | None = None
) -> str:
    return table.create(name, scopes, days, make_deed()).token.get_secret_value()


@pytest.mark.attack("tokens", "reading the database")
def test_only_the_hash_is_stored_and_the_secret_has_256_bits(table: Tokens, engine: sql.Engine, tmp_path: Path) -> None:
    token = issue(table)
    with engine.connect() as connection:
        row = connection.execute(sql.select(token_table)).mappings().one()
    assert row["sha256"] == hashlib.sha256(token.encode()).hexdigest()
    assert token.startswith(f"dentine_{row['id']}_")
    secret = token.split("_", 2)[2]
    assert len(secret) == 43
    assert secret.encode() not in b"".join(path.read_bytes() for path in tmp_path.iterdir())


def test_a_thousand_tokens_differ(engine: sql.Engine) -> None:
    with writing(engine) as connection:
        issued = [
            insert_token(connection, f"t-{number}", [Scope.READ], NOON_S, None, make_deed()) for number in range(1000)
        ]
    made = {one.token.get_secret_value() for one in issued}
    assert len({token.split("_", 2)[2] for token in made}) == len(made) == 1000


def test_a_token_is_known_by_all_of_it(table: Tokens) -> None:
    token = issue(table)
    assert table.authenticate(token).name == "rig-1"
    other = issue(table, "rig-2")
    mixed = f"dentine_{token.split('_')[1]}_{other.split('_', 2)[2]}"
    for wrong in (
        mixed,
        token[:-1],
        token + "A",
        token.upper(),
        "",
        "dentine_",
        "dentine_000000000000_x",
        "\udcff\x00é",
    ):
        with pytest.raises(UnauthenticatedError, match="unknown, expired or revoked; ask an administrator"):
            table.authenticate(wrong)


@pytest.mark.parametrize("known", [True, False])
def test_the_decision_is_compare_digest_of_two_hashes(
    table: Tokens, monkeypatch: pytest.MonkeyPatch, known: bool
) -> None:
    token = issue(table) if known else "dentine_0123456789ab_guess"
    compared: list[tuple[str, str]] = []

    def refuse(given: str, stored: str) -> bool:
        compared.append((given, stored))
        return False

    monkeypatch.setattr(hmac, "compare_digest", refuse)
    assert tokens.hmac is hmac  # type: ignore[attr-defined]  # the module's own import is what is tested
    with pytest.raises(UnauthenticatedError):
        table.authenticate(token)
    ((given, stored),) = compared
    assert given == hashlib.sha256(token.encode()).hexdigest()
    assert len(stored) == len(given) == 64
    assert (given == stored) is known


@pytest.mark.parametrize(
    ("held", "allowed"),
    [
        ({Scope.READ}, {Scope.READ}),
        ({Scope.SUBMIT}, {Scope.READ, Scope.SUBMIT}),
        ({Scope.OPERATE_DOME}, {Scope.OPERATE_DOME}),
        ({Scope.SUBMIT, Scope.OPERATE_DOME}, {Scope.READ, Scope.SUBMIT, Scope.OPERATE_DOME}),
        ({Scope.METRICS}, {Scope.METRICS}),
        ({Scope.ADMIN}, set(Scope)),
    ],
)
def test_scopes_include_each_other(table: Tokens, held: set[Scope], allowed: set[Scope]) -> None:
    assert Caller.of(table.authenticate(issue(table, scopes=tuple(held)))).scopes == allowed


def test_a_token_ends_when_it_expires(table: Tokens, clock: Clock) -> None:
    token = issue(table, days=2)
    clock.now_s = NOON_S + 2 * DAY_S - 1
    assert table.authenticate(token)
    clock.now_s = NOON_S + 2 * DAY_S
    with pytest.raises(UnauthenticatedError):
        table.authenticate(token)


def test_a_revoked_token_ends_at_once_and_stays_listed(table: Tokens) -> None:
    token = issue(table)
    ended = table.revoke("rig-1", make_deed())
    with pytest.raises(UnauthenticatedError):
        table.authenticate(token)
    assert table.revoke(ended.id, make_deed()) == ended
    assert [one.revoked_s for one in table.list()] == [NOON_S]
    with pytest.raises(UnknownTokenError, match="There is no token rig-1"):
        table.revoke("rig-1", make_deed())


def test_a_token_that_was_found_is_trusted_for_a_second(table: Tokens, engine: sql.Engine, clock: Clock) -> None:
    token = issue(table)
    assert table.trusted(presented=token) is None
    found = table.authenticate(token)
    clock.now_s += tokens.TRUSTED_S - 0.01
    assert table.trusted(presented=token) == found
    Tokens(engine, clock).revoke(found.id, make_deed())  # another process
    clock.now_s += 0.02
    assert table.trusted(presented=token) is None
    with pytest.raises(UnauthenticatedError):
        table.authenticate(token)


def test_trust_ends_with_the_token(table: Tokens, clock: Clock) -> None:
    token = issue(table, days=1)
    clock.now_s += DAY_S - 0.5
    found = table.authenticate(token)
    clock.now_s += 0.5
    assert table.trusted(presented=token) is None
    token = issue(table, "rig-2")
    found = table.authenticate(token)
    table.revoke(found.id, make_deed())
    assert table.trusted(presented=token) is None


def test_trust_ends_in_time_though_the_clock_steps_back(table: Tokens, clock: Clock) -> None:
    token = issue(table)
    table.authenticate(token)
    clock.step(-3600)
    assert table.trusted(presented=token) is not None
    clock.now_s += tokens.TRUSTED_S
    assert table.trusted(presented=token) is None


def test_a_token_that_is_revoked_while_it_is_looked_up_is_not_trusted(
    table: Tokens, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The look-up has read its row when the token is revoked.
    token = issue(table)
    monkeypatch.setattr(table, "_note_use", lambda _: table.revoke("rig-1", make_deed()))
    table.authenticate(token)
    assert table.trusted(presented=token) is None


def test_an_id_never_passes_for_a_token(table: Tokens) -> None:
    found = table.authenticate(token := issue(table))
    table.authenticate_session(found.id)
    assert [one.id for one in (table.trusted(session_of=found.id), table.trusted(presented=token)) if one] == [
        found.id,
        found.id,
    ]
    assert table.trusted(presented=found.id) is None
    assert table.trusted(session_of=token) is None


def test_a_name_has_one_living_token(table: Tokens, clock: Clock) -> None:
    issue(table, days=1)
    with pytest.raises(InputError, match="'rig-1' is in use"):
        issue(table)
    clock.now_s += DAY_S
    issue(table)
    table.revoke("rig-1", make_deed())
    assert issue(table)


def test_an_id_means_its_own_token_whatever_another_is_called(table: Tokens, engine: sql.Engine) -> None:
    """A name could once be any text, even another token's id."""
    issue(table, "first")
    meant = table.list()[0].id
    issue(table, "second")
    with engine.begin() as connection:
        connection.execute(token_table.update().where(token_table.c.name == "second").values(name=meant))
    assert table.revoke(meant, make_deed()).name == "first"
    assert {one.name: one.revoked_s is None for one in table.list()} == {"first": False, meant: True}


@pytest.mark.parametrize(
    "name", ["", "local", "0123456789ab", "a b", "-x", "x" * 65, "dentine_0123456789ab_secret", "é"]
)
def test_malformed_names_are_refused(table: Tokens, name: str) -> None:
    with pytest.raises(InputError, match="Token name"):
        issue(table, name)


def test_a_token_needs_a_scope(table: Tokens) -> None:
    with pytest.raises(InputError, match="has no scope; give at least one of read, submit"):
        issue(table, scopes=())


def test_the_last_use_is_noted_once_an_hour(table: Tokens, engine: sql.Engine, clock: Clock) -> None:
    token = issue(table)
    assert table.list()[0].last_used_s is None
    writes: list[str] = []
    sql.event.listen(
        engine,
        "before_cursor_execute",
        lambda *arguments: writes.append(arguments[2]) if arguments[2].startswith("UPDATE") else None,
    )
    for step in range(11):
        clock.now_s = NOON_S + step * LAST_USE_STEP_S / 10
        table.authenticate(token)
    assert len(writes) == 2
    assert table.list()[0].last_used_s == NOON_S + LAST_USE_STEP_S


def test_making_and_revoking_are_audited_with_the_change_itself(table: Tokens, engine: sql.Engine) -> None:
    issue(table)
    table.revoke("rig-1", make_deed())
    rows = AuditLog(engine).page(10)
    ids = {"token_id": table.list()[0].id}
    assert [(row.who, row.outcome, row.ids) for row in rows] == [("local", 200, ids), ("local", 201, ids)]
    with pytest.raises(InputError):
        issue(table, "a b")
    assert len(AuditLog(engine).page(10)) == 2


def test_nothing_that_is_printed_shows_a_secret(table: Tokens) -> None:
    issued = table.create("rig-1", [Scope.READ], None, make_deed())
    secret = issued.token.get_secret_value().split("_", 2)[2]
    assert secret in issued.model_dump_json()
    for text in (
        repr(issued),
        str(issued),
        f"{issued}",
        str(issued.model_dump()),
        str(table.list()),
        redacted(f"no {issued.token.get_secret_value()} here"),
    ):
        assert secret not in text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a dentine_0123456789ab_x-Y_z012345 b", "a dentine_0123456789ab_… b"),
        ("dentine_0123456789ab_1800000000.abcdef0123", "dentine_0123456789ab_…"),
        ("whsec_MfKQ9r8GKYqrTwjUPD8ILPZIo2LaLaSw=", "whsec_…"),
        ("dark_0123456789ab_1795000000_ab12.cd34", "dark_0123456789ab_…"),
        ("/v1/jobs/dentine", "/v1/jobs/dentine"),
    ],
)
def test_redaction_keeps_what_is_public(text: str, shown: str) -> None:
    assert redacted(text) == shown


def test_a_session_stands_for_its_token_until_it_is_over(table: Tokens, clock: Clock) -> None:
    issuer = Sessions(b"k" * 32, 60.0, clock)
    token = table.authenticate(issue(table))
    cookie, lifetime_s = issuer.issue(token)
    assert (issuer.read(cookie).token_id, lifetime_s) == (token.id, 60)
    clock.now_s += 60
    with pytest.raises(UnauthenticatedError, match="This session is over"):
        issuer.read(cookie)


def test_a_session_never_outlives_its_token(table: Tokens, clock: Clock) -> None:
    token = table.authenticate(issue(table, days=1))
    clock.now_s = NOON_S + DAY_S - 10
    assert Sessions(b"k" * 32, 60.0, clock).issue(token)[1] == 10


def test_a_changed_session_is_refused(table: Tokens, clock: Clock) -> None:
    issuer = Sessions(b"k" * 32, 60.0, clock)
    cookie, _ = issuer.issue(table.authenticate(issue(table)))
    claim, _, signature = cookie.rpartition(".")
    later = f"{claim[:-10]}{int(NOON_S) + 9999}.{signature}"
    for wrong in (later, cookie[:-1], claim, "", ".", "é", f"{claim}.é", cookie.replace("dentine_", "dentine_0", 1)):
        with pytest.raises(UnauthenticatedError):
            issuer.read(wrong)
    with pytest.raises(UnauthenticatedError):
        Sessions(b"l" * 32, 60.0, clock).read(cookie)


def test_signatures_are_compared_by_compare_digest(
    table: Tokens, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    issuer = Sessions(b"k" * 32, 60.0, clock)
    cookie, _ = issuer.issue(table.authenticate(issue(table)))
    monkeypatch.setattr(hmac, "compare_digest", lambda *_: False)
    assert sessions.hmac is hmac  # type: ignore[attr-defined]  # the module's own import is what is tested
    with pytest.raises(UnauthenticatedError):
        issuer.read(cookie)


def test_the_signing_key_is_kept_and_is_its_owners_alone(tmp_path: Path) -> None:
    key = read_key(tmp_path)
    assert len(key) == 32
    assert read_key(tmp_path) == key
    (path,) = tmp_path.iterdir()
    assert path.stat().st_mode & 0o777 == 0o600
