"""How a server treats jobs that are not running yet, or that it must stop."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from services.api.jobs import admission
from services.api.jobs.admission import Needs
from services.api.jobs.jobs import Jobs
from services.api.jobs.records import Lease
from services.api.tables.lifecycle import JobState
from services.core.errors import DiskFullError
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import CANCEL_FLAG
from services.pipeline.database import writing


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Jobs]:
    service = Jobs(ServerSettings(data=tmp_path / "data"), lambda *_: None)
    yield service
    service.repository.close()


def test_only_a_queued_job_waits_for_something(service: Jobs, tmp_path: Path) -> None:
    job = service.submit(JobSpec(capture=tmp_path)).job
    service._admission.pause(job.id, DiskFullError("It was full."))
    assert service._admission.holds(job.id, job.spec)
    assert service.waits_for(job) == "Waits for disk: It was full."
    assert service.waits_for(service.cancel(job.id)) is None


def test_a_capture_that_takes_long_to_measure_holds_up_no_other_submission(
    service: Jobs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (slow := tmp_path / "slow").mkdir()
    measuring, go_on = threading.Event(), threading.Event()

    def measure(spec: JobSpec) -> Needs:
        if spec.capture == slow:
            measuring.set()
            assert go_on.wait(30)
        return Needs(0, 0)

    monkeypatch.setattr(admission, "predict", measure)
    first = threading.Thread(target=service.submit, args=(JobSpec(capture=slow),))
    second = threading.Thread(target=service.submit, args=(JobSpec(capture=tmp_path),))
    first.start()
    assert measuring.wait(30)
    second.start()
    second.join(10)
    assert [job.spec.capture for job in service.repository.queued()] == [tmp_path]
    go_on.set()
    first.join()
    assert len(service.repository.queued()) == 2


def test_a_long_round_keeps_no_lease_from_being_renewed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.api.jobs.runner.ROUND_S", 0.05)
    running, deleting, go_on, renewed = (threading.Event() for _ in range(4))
    begun_under: list[int] = []

    def hold(*_: object) -> None:
        running.set()
        assert go_on.wait(60)

    def delete_for_long(*_: object) -> None:
        deleting.set()
        assert go_on.wait(60)

    service = Jobs(ServerSettings(data=tmp_path / "data"), hold)
    monkeypatch.setattr(service._runner, "_on_round", delete_for_long)
    renew = service.repository.renew

    def note_renewal(lease: Lease, seconds: float) -> bool:
        if deleting.is_set():
            begun_under.append(lease.number)
            renewed.set()
        return renew(lease, seconds)

    monkeypatch.setattr(service.repository, "renew", note_renewal)
    service.start()
    try:
        service.submit(JobSpec(capture=tmp_path))
        assert running.wait(60)
        assert deleting.wait(60)
        renewed.clear()
        assert renewed.wait(60), "whoever deletes renews no lease"
    finally:
        go_on.set()
        service.close()
    assert set(begun_under) == {1}


def test_a_job_is_told_to_stop_while_the_database_keeps_writers_waiting(service: Jobs, tmp_path: Path) -> None:
    job = service.submit(JobSpec(capture=tmp_path)).job
    service.repository.lease(job.id, "test", 60.0)
    flag = service.folder(job.id) / CANCEL_FLAG
    flag.parent.mkdir(parents=True)
    with writing(service.repository.engine):
        cancelling = threading.Thread(target=service.cancel, args=(job.id,))
        cancelling.start()
        deadline_s = time.monotonic() + 4  # before the waiting writer gives up
        while not flag.exists():
            assert time.monotonic() < deadline_s, "the job was not told to stop before the cancel was recorded"
            time.sleep(0.005)
        assert service.repository.get(job.id).state is JobState.RUNNING
    cancelling.join()
    assert service.repository.get(job.id).state is JobState.CANCELLING


def test_why_a_job_waits_is_told_as_an_event_once_and_without_the_servers_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    service = Jobs(ServerSettings(data=data, job_roots=str(tmp_path)), lambda *_: None)
    reasons = [
        f"Waits for disk: The disk was full at {data}/jobs/x; free some space.",
        "Waits for disk: 0.1 GiB are free.",
        "Waits for a place: job 1 runs.",
    ]
    try:
        job = service.submit(JobSpec(capture=tmp_path)).job
        monkeypatch.setattr(service._admission, "holds", lambda *_, **__: True)
        for reason in (*reasons[:2], *reasons):
            service._admission._reasons[job.id] = reason
            monkeypatch.setattr(service._admission, "begin_round", lambda _: None)
            service._runner._start_admitted()
            assert str(data) not in (service.waits_for(job) or "")
        told = [event.message for event in service.repository.events_of(job.id).read(kind="log")]
        assert told == ["Waits for disk: The disk was full at jobs/x; free some space."]
    finally:
        service.repository.close()
