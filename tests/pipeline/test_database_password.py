"""The database's password is read from a file, can change without a restart, is in no task, and errors with it are one
sentence.
"""

from __future__ import annotations

import pickle
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sql
from pydantic import SecretStr

from services.api.deployment.password_change import change_database_password
from services.api.jobs.jobs import Jobs
from services.core.errors import PlatformError, SettingsError
from services.core.records import JobSpec
from services.core.settings import ServerSettings, read_settings
from services.pipeline.database import open_database
from tests.support.postgres import PostgresServer, new_database, postgres_server
from tests.support.uploading import write_capture

AWKWARD = "q/8+Zk@1#x:%"
"""Password with characters that URLs escape, as generated passwords have them."""


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    """A Postgres server that requires passwords, also over its socket."""
    with postgres_server() as server:
        engine = open_database(server.url("postgres"))
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.exec_driver_sql(f"CREATE ROLE dentine LOGIN CREATEDB PASSWORD '{AWKWARD.replace('%', '%%')}'")
            data = connection.exec_driver_sql("SHOW data_directory").scalar_one()
            Path(data, "pg_hba.conf").write_text("local all postgres trust\nlocal all all scram-sha-256\n")
            connection.exec_driver_sql("SELECT pg_reload_conf()")
        engine.dispose()
        yield server


@pytest.fixture
def url(server: PostgresServer, request: pytest.FixtureRequest) -> str:
    """URL of an empty database of the role, without the password."""
    name = f"of_{abs(hash(request.node.name))}"
    address = new_database(server, name).replace("postgres@", "dentine@", 1)
    owner = open_database(server.url(name))
    with owner.begin() as connection:
        connection.exec_driver_sql("GRANT ALL ON SCHEMA public TO dentine")
    owner.dispose()
    return address


def settings(tmp_path: Path, url: str, password: str) -> ServerSettings:
    (tmp_path / "password").write_text(f"{password}\n")
    return ServerSettings(data=tmp_path / "data", database=SecretStr(url), database_password_file=tmp_path / "password")


def test_any_password_works_from_a_file(tmp_path: Path, url: str) -> None:
    Jobs(settings(tmp_path, url, AWKWARD), lambda *_: None).repository.close()


def test_a_wrong_password_is_one_sentence(tmp_path: Path, url: str) -> None:
    with pytest.raises(PlatformError) as told:
        Jobs(settings(tmp_path, url, "guess"), lambda *_: None)
    assert "password authentication failed for user" in told.value.message
    assert "DENTINE__SERVER__DATABASE_PASSWORD_FILE" in told.value.message
    assert "guess" not in told.value.message
    assert "\n" not in told.value.message


def test_a_password_that_breaks_its_url_is_not_repeated() -> None:
    broken = read_settings({"DENTINE__SERVER__DATABASE": f"postgresql://dentine:{AWKWARD}@postgres/dentine"}).server
    with pytest.raises(SettingsError, match="malformed") as told:
        open_database(broken.database_url)
    assert not any(part in told.value.message for part in ("q/8", "Zk", "1#x"))


def test_no_password_travels_inside_a_task(tmp_path: Path, url: str) -> None:
    with_password = sql.make_url(url).set(password=AWKWARD).render_as_string(hide_password=False)
    jobs = Jobs(ServerSettings(data=tmp_path / "data", database=SecretStr(with_password)), lambda *_: None)
    job = jobs.submit(JobSpec(capture=write_capture(tmp_path / "capture"))).job
    lease = jobs.repository.lease(job.id, "me", 60)
    address = jobs.repository.address_of(lease)
    travelling = pickle.dumps(address)
    for written in (AWKWARD, "q%2F8"):
        assert written.encode() not in travelling
    with pickle.loads(travelling).open() as log:
        assert log.newest_id() > 0
    assert stat.S_IMODE((tmp_path / "data" / "database.password").stat().st_mode) == 0o600
    jobs.repository.close()


def test_a_changed_password_needs_no_restart(tmp_path: Path, url: str, server: PostgresServer) -> None:
    chosen = settings(tmp_path, url, AWKWARD)
    jobs = Jobs(chosen, lambda *_: None)
    try:
        change_database_password(chosen.database_url, tmp_path / "password")
        assert (tmp_path / "password").read_text().strip() != AWKWARD
        jobs.repository.engine.dispose()  # all later connections use the new password
        assert jobs.repository.queued() == []
    finally:
        jobs.repository.close()
        superuser = open_database(server.url("postgres"))
        with superuser.begin() as connection:
            connection.exec_driver_sql(f"ALTER ROLE dentine PASSWORD '{AWKWARD.replace('%', '%%')}'")
        superuser.dispose()


@pytest.mark.parametrize(("content", "reason"), [(None, "No such file"), (b"\n", "is empty"), (b"\xff\xfe", "no text")])
def test_a_bad_password_file_is_named(tmp_path: Path, content: bytes | None, reason: str) -> None:
    if content is not None:
        (tmp_path / "password").write_bytes(content)
    chosen = ServerSettings(
        data=tmp_path / "data",
        database=SecretStr("postgresql://dentine@127.0.0.1:1/x"),
        database_password_file=tmp_path / "password",
    )
    with pytest.raises(SettingsError, match=reason) as told:
        Jobs(chosen, lambda *_: None)
    assert str(tmp_path / "password") in told.value.message
