"""Removing a job's folder, also when the removal is interrupted."""

from __future__ import annotations

import hashlib
import shutil
import threading
from pathlib import Path

import pytest

from services.api.jobs import erasure, jobs
from services.api.jobs.erasure import Erased, erase, forget_listing
from services.api.jobs.jobs import Jobs
from services.api.tables.jobs import job_table
from services.api.tables.lifecycle import JobState, Trigger
from services.core.errors import StoreError
from services.core.records import JobSpec
from services.core.settings import ServerSettings


def write_job(folder: Path) -> str:
    """Two files; returns the digest that the receipt must hold."""
    (folder / "fit").mkdir(parents=True)
    lines = []
    for name, content in (("fit/shard", b"abc"), ("job.json", b"{}")):
        (folder / name).write_bytes(content)
        lines.append(f"{name} {len(content)} {hashlib.sha256(content).hexdigest()}\n")
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def test_nothing_is_left_and_the_receipt_tells_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "job"
    digest = write_job(folder)
    erased = erase(folder)
    assert (erased.files, erased.bytes, erased.digest) == (2, 5, digest)
    forget_listing(folder)
    assert list(tmp_path.iterdir()) == []


def test_a_removal_that_was_cut_short_counts_from_its_beginning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "job"
    digest = write_job(folder)

    def stop(path: Path) -> None:
        (Path(path) / "job.json").unlink()
        raise PermissionError(13, "Permission denied", str(path / "fit"))

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "rmtree", stop)
        with pytest.raises(StoreError, match=r"fit could not be removed \(Permission denied\)"):
            erase(folder)
    assert erase(folder).digest == digest
    assert not folder.exists()
    assert erase(folder).files == 2  # and again, until the receipt is kept


def test_an_absent_folder_is_empty(tmp_path: Path) -> None:
    assert erase(tmp_path / "none").files == 0


def test_a_job_that_never_ran_is_deleted_before_there_is_any_folder_of_jobs(tmp_path: Path) -> None:
    service = Jobs(ServerSettings(data=tmp_path / "data"), lambda *_: None)
    job = service.repository.create(JobSpec(capture=tmp_path), key=None).job.id
    service.repository.apply(job, Trigger.CANCEL)
    assert service.delete(job).files == 0
    assert list((tmp_path / "data" / "jobs").iterdir()) == []
    service.repository.close()


def test_a_file_that_cannot_be_read_or_noted_is_told_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_job(folder := tmp_path / "job")

    def refuse(*_: object) -> None:
        raise OSError(5, "Input/output error", str(folder / "fit" / "shard"))

    for broken in ("file_digest", "write_atomic"):
        with monkeypatch.context() as patched:
            patched.setattr(hashlib if broken == "file_digest" else erasure, broken, refuse)
            with pytest.raises(StoreError, match=r"shard could not be removed \(Input/output error\)"):
                erase(folder)
    assert erase(folder).files == 2


def test_a_round_goes_on_after_a_job_that_cannot_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    service = Jobs(ServerSettings(data=tmp_path / "data", keep_days=1), lambda *_: None)
    broken, refused, sound = (service.repository.create(JobSpec(capture=tmp_path), key=None).job.id for _ in range(3))
    for job in (broken, refused, sound):
        service.repository.apply(job, Trigger.CANCEL)
    with service.repository.engine.begin() as connection:
        connection.execute(job_table.update().values(changed_s=0.0))
    problems = {broken: OSError(5, "Input/output error"), refused: StoreError("No.")}

    def erase_or_break(folder: Path) -> Erased:
        if folder.name in problems:
            raise problems[folder.name]
        return erase(folder)

    monkeypatch.setattr(jobs, "erase", erase_or_break)
    service._tidy()
    assert service.repository.deletion(sound).files == 0
    assert [service.repository.get(job).state for job in (broken, refused)] == [JobState.DELETING] * 2
    assert [record.getMessage().split(":")[0] for record in caplog.records if record.name == jobs.__name__] == [
        f"job {broken}",
        f"job {refused}",
    ]
    service.repository.close()


def test_a_round_that_meets_a_deletion_lets_it_finish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, erased, problems, second = tmp_path / "data", [], [], threading.Event()
    service = Jobs(ServerSettings(data=data), lambda *_: None)
    job = service.repository.create(JobSpec(capture=tmp_path), key=None).job.id
    service.repository.apply(job, Trigger.CANCEL)
    write_job(service.folder(job))

    def tidy() -> None:
        try:
            service._tidy()
        except Exception as problem:
            problems.append(problem)

    round_of_server = threading.Thread(target=tidy)

    def erase_during_a_round(folder: Path) -> Erased:
        erased.append(folder)
        if len(erased) == 1:
            round_of_server.start()
            second.wait(0.3)
        second.set()
        return erase(folder)

    monkeypatch.setattr(jobs, "erase", erase_during_a_round)
    receipt = service.delete(job)
    round_of_server.join()
    assert (receipt.files, len(erased), problems) == (2, 1, [])
    service.repository.close()
