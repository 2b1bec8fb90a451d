"""Jobs in the database, with SQLite and with Postgres: leases, fencing, deletion, and what an older version stored."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import sqlalchemy as sql
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from services.api import data_folder
from services.api.auth import audit, ended_sessions, setup_links, tokens
from services.api.jobs.records import Failure
from services.api.jobs.repository import Repository
from services.api.migrations import FIRST, upgrade
from services.api.tables import captures as capture_table
from services.api.tables import webhooks as webhook_tables
from services.api.tables.jobs import JobFilter, job_table
from services.api.tables.lifecycle import JobState, Trigger
from services.client.errors import JobStateError, UnknownJobError
from services.core.errors import FencedError, SettingsError
from services.core.records import JobSpec
from services.pipeline.database import Query, metadata, open_database, retry_while_lost, sqlite_url, writing
from services.pipeline.event_log import event_table
from tests.support.empty_database import empty_database
from tests.support.postgres import PostgresServer, new_database, postgres_server

SPEC = JobSpec(capture=Path("/mouth"))
UPGRADED = "upgraded"
"""Database of the Postgres server that has all tables, and is copied."""
names = (f"test_{number}" for number in itertools.count())


class Clock:
    """Unix time that a test sets."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture(scope="module")
def server() -> Iterator[PostgresServer]:
    with postgres_server() as running:
        engine = open_database(new_database(running, UPGRADED))
        upgrade(engine)
        engine.dispose()
        yield running


@pytest.fixture(params=["sqlite", "postgres"])
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A database that has all tables."""
    if request.param == "sqlite":
        return empty_database(tmp_path / "jobs.sqlite")
    return new_database(request.getfixturevalue("server"), next(names), UPGRADED)


@pytest.fixture(params=["sqlite", "postgres"])
def url_without_tables(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    if request.param == "sqlite":
        return sqlite_url(tmp_path / "jobs.sqlite")
    return new_database(request.getfixturevalue("server"), next(names))


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def opened(url: str, clock: Clock) -> Iterator[Callable[[], Repository]]:
    made: list[Repository] = []

    def open_one() -> Repository:
        made.append(Repository(url, clock))
        return made[-1]

    yield open_one
    for one in made:
        one.close()


@pytest.fixture
def repository(opened: Callable[[], Repository]) -> Repository:
    return opened()


def test_a_lease_starts_a_job_and_the_next_one_has_a_higher_number(repository: Repository) -> None:
    job = repository.create(SPEC, None).job
    first = repository.lease(job.id, "a", 60)
    assert (first.job.state, first.number) == (JobState.RUNNING, 1)
    with pytest.raises(JobStateError):
        repository.lease(job.id, "b", 60)
    repository.settle(first, Trigger.FAIL, Failure(code="x", message="y", exit_status=1))
    repository.apply(job.id, Trigger.RETRY)
    assert repository.lease(job.id, "b", 60).number == 2


def test_what_is_not_renewed_is_lost_and_its_holder_has_no_say_any_more(repository: Repository, clock: Clock) -> None:
    job = repository.create(SPEC, None).job
    old = repository.lease(job.id, "a", 60)
    clock.now_s += 50
    assert repository.renew(old, 60)
    clock.now_s += 50
    assert repository.lose_expired() == []
    clock.now_s += 20
    assert repository.lose_expired([old]) == []  # a runner that names its lease still holds it, whatever the clock says
    assert repository.lose_expired() == [job.id]
    new = repository.lease(job.id, "b", 60)
    assert not repository.renew(old, 60)
    with pytest.raises(FencedError, match="taken over under lease 2"):
        repository.settle(old, Trigger.SUCCEED)
    with repository.address_of(old).open() as log, pytest.raises(FencedError, match="taken over under lease 2"):
        log.begin_stage("fit")
    with repository.address_of(new).open() as log:
        assert log.begin_stage("fit") == 1
    assert repository.settle(new, Trigger.SUCCEED).state is JobState.SUCCEEDED


def test_a_lease_from_before_the_clock_stepped_back_is_not_waited_for(repository: Repository, clock: Clock) -> None:
    clock.now_s += 3600
    job = repository.create(SPEC, None).job
    repository.lease(job.id, "dead", 60)
    clock.now_s -= 3600
    assert repository.lose_expired(length_s=60) == [job.id]
    repository.lease(job.id, "alive", 60)
    clock.now_s -= 59  # as much as clocks of servers may differ
    assert repository.lose_expired(length_s=60) == []


def test_a_server_that_stopped_working_on_a_job_loses_it_like_any_other(repository: Repository, clock: Clock) -> None:
    # The lease that the runner works under now decides what it holds, not its name: a runner that stopped half way must
    # not keep its job for ever.
    broken, current = (repository.lease(repository.create(SPEC, None).job.id, "a", 60) for _ in range(2))
    clock.now_s += 70
    assert repository.lose_expired([current]) == [broken.job.id]


def test_many_servers_at_once_never_lease_one_job_twice(opened: Callable[[], Repository]) -> None:
    repositories = [opened() for _ in range(4)]
    jobs = [repositories[0].create(SPEC, None).job.id for _ in range(12)]
    taken: list[str] = []

    def take(repository: Repository) -> None:
        for job in jobs:
            try:
                taken.append(repository.lease(job, "x", 60).job.id)
            except JobStateError:
                continue

    threads = [threading.Thread(target=take, args=(one,)) for one in repositories]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(jobs)


def test_submissions_of_one_key_at_once_make_one_job(opened: Callable[[], Repository]) -> None:
    repositories, made = [opened() for _ in range(4)], []
    threads = [
        threading.Thread(target=lambda one=one: made.append(one.create(SPEC, "key").job.id)) for one in repositories
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 4
    assert len(set(made)) == 1


def test_every_job_under_way_is_lost_when_the_only_server_died(repository: Repository) -> None:
    running, cancelling, queued = (repository.create(SPEC, None).job.id for _ in range(3))
    for job in (running, cancelling):
        repository.lease(job, "dead", 3600)
    repository.apply(cancelling, Trigger.CANCEL)
    assert repository.lose() == [running, cancelling]
    assert [repository.get(job).state for job in (running, cancelling, queued)] == [
        JobState.QUEUED,
        JobState.CANCELLED,
        JobState.QUEUED,
    ]


def test_a_deleted_job_leaves_its_receipt_alone(repository: Repository, clock: Clock) -> None:
    secret = "/people/patient-4711"
    job = repository.create(JobSpec(capture=Path(secret)), None).job
    with pytest.raises(JobStateError):
        repository.apply(job.id, Trigger.DELETE)
    repository.settle(repository.lease(job.id, "a", 60), Trigger.SUCCEED)
    assert repository.ended_before(clock.now_s) == []
    assert repository.ended_before(clock.now_s + 1) == [job.id]
    repository.apply(job.id, Trigger.DELETE)
    assert repository.ended_before(0) == [job.id]
    receipt = repository.forget(job.id, 3, 17, "abc")
    assert repository.deletion(job.id) == receipt
    with pytest.raises(UnknownJobError):
        repository.get(job.id)
    with repository.engine.connect() as connection:
        for table in metadata.sorted_tables:
            assert secret not in str(connection.execute(sql.select(table)).all())
        assert connection.scalar(sql.select(sql.func.count()).select_from(event_table)) == 0


def test_a_filter_may_name_its_states_any_number_of_times(repository: Repository) -> None:
    queued, cancelled, _ = (repository.create(SPEC, None).job.id for _ in range(3))
    repository.apply(cancelled, Trigger.CANCEL)
    repository.lease(queued, "a", 60)
    only = JobFilter(states=(JobState.CANCELLED, JobState.RUNNING) * 2000)
    assert [job.id for job in repository.page(9, only=only)] == [cancelled, queued]


def test_events_become_visible_in_the_order_of_their_ids(opened: Callable[[], Repository]) -> None:
    # A reader that asks for events newer than the last id it saw must miss none, however many write.
    repositories = [opened() for _ in range(4)]
    seen: list[int] = []
    done = threading.Event()

    def write(repository: Repository) -> None:
        for _ in range(15):
            repository.create(SPEC, None)

    def read() -> None:
        last = 0
        while True:
            ended = done.is_set()
            with repositories[0].engine.connect() as connection:
                new = list(
                    connection.scalars(
                        sql.select(event_table.c.id).where(event_table.c.id > last).order_by(event_table.c.id)
                    )
                )
            seen.extend(new)
            last = new[-1] if new else last
            if ended:
                return

    reader, writers = (
        threading.Thread(target=read),
        [threading.Thread(target=write, args=(one,)) for one in repositories],
    )
    reader.start()
    for writer in writers:
        writer.start()
    for writer in writers:
        writer.join()
    done.set()
    reader.join()
    with repositories[0].engine.connect() as connection:
        assert seen == list(connection.scalars(sql.select(event_table.c.id).order_by(event_table.c.id)))
    assert len(seen) == 4 * 15 * 2


def test_the_steps_lead_to_the_tables_that_the_code_knows(repository: Repository) -> None:
    known = (
        webhook_tables.webhook_table,
        tokens.token_table,
        audit.audit_table,
        capture_table.capture_table,
        data_folder.data_folder_table,
    )
    for table in (*known, setup_links.setup_link_table, ended_sessions.ended_session_table):
        assert table.metadata is metadata
    with repository.engine.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), metadata) == []


def test_a_database_from_before_the_steps_keeps_its_jobs(url_without_tables: str, clock: Clock) -> None:
    engine = open_database(url_without_tables)
    upgrade(engine, FIRST)
    row = {
        "id": "old",
        "key": None,
        "state": "RUNNING",
        "created_s": 1.0,
        "changed_s": 2.0,
        "spec": SPEC.model_dump_json(),
    }
    with engine.begin() as connection:
        connection.execute(job_table.insert().values(row))
        connection.execute(sql.text("DROP TABLE alembic_version"))
    engine.dispose()
    repository = Repository(url_without_tables, clock)
    assert [job.id for job in repository.page(9, only=JobFilter(kind="tooth", source="MOUTH"))] == ["old"]
    assert repository.lose_expired() == ["old"]
    assert repository.lease("old", "me", 60).number == 1
    repository.close()


@pytest.mark.parametrize("bad", ["mysql://host/name", "not a url"])
def test_other_databases_are_refused_by_name(bad: str) -> None:
    with pytest.raises(SettingsError, match="postgresql"):
        open_database(bad)


def test_a_client_that_falls_silent_in_a_transaction_keeps_no_lock(
    server: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.pipeline.database.POSTGRES_SILENCE_S", 1)
    silent, other = open_database(server.url("postgres")), open_database(server.url("postgres"))
    tries: list[int] = []

    def write() -> int:
        tries.append(1)
        with writing(silent) as connection:
            if len(tries) == 1:
                with writing(other):  # possible only after the server has ended the silent transaction
                    pass
            return int(connection.scalar(sql.select(1)) or 0)

    assert retry_while_lost(write) == 1
    assert len(tries) == 2
    for engine in (silent, other):
        engine.dispose()


def test_writers_of_one_process_take_turns_before_they_ask_sqlite(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("services.pipeline.database.BUSY_MS", 0)  # a writer that is not first is refused at once
    engine = open_database(empty_database(tmp_path / "jobs.sqlite"))
    written: list[bool] = []

    def write() -> None:
        with writing(engine) as connection:
            connection.execute(sql.text("UPDATE job SET changed_s = 0"))
            written.append(True)

    with writing(engine):
        others = [threading.Thread(target=write) for _ in range(4)]
        for other in others:
            other.start()
        others[0].join(0.2)
        assert not written
    for other in others:
        other.join()
    assert len(written) == len(others)
    engine.dispose()


def test_a_query_that_the_database_does_not_answer_is_told_as_such(tmp_path: Path) -> None:
    engine = open_database(sqlite_url(tmp_path / "empty.sqlite"))
    with pytest.raises(sql.exc.OperationalError, match="no such table"):
        Query(sql.select(job_table)).rows(engine)
    engine.dispose()
