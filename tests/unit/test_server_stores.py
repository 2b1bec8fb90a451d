"""Which S3 stores a server lets jobs name; a deleted job leaves nothing in them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from services.api.jobs.erasure import erase
from services.api.jobs.jobs import Jobs
from services.api.jobs.server_paths import ServerStores
from services.core.errors import PlatformError, SettingsError, StoreError
from services.core.files import object_store
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.preprocess.tasks.attempt_files import AttemptFiles
from tests.support.folder_captures import prepare, write_folder
from tests.support.s3_server import BUCKET, s3_server, use


def spec(store: str | None) -> JobSpec:
    return JobSpec(capture=Path("/captures/one"), store=store)


@pytest.mark.parametrize("store", [None, "s3://teeth/lab", "s3://teeth/lab/two", "s3://other"])
def test_allowed(store: str | None) -> None:
    ServerStores(ServerSettings(stores="s3://teeth/lab, s3://other")).require(spec(store))


@pytest.mark.parametrize(
    ("allowed", "store"),
    [
        ("", "s3://teeth"),
        ("s3://teeth/lab", "s3://teeth"),
        ("s3://teeth/lab", "s3://teeth/laboratory"),
        ("s3://teeth/lab", "s3://teeth-lab/lab"),
        ("s3://teeth", "s3://teeth2"),
    ],
)
def test_not_allowed(allowed: str, store: str) -> None:
    known = allowed or "none"
    with pytest.raises(
        SettingsError,
        match=rf"^Option 'store': .* at {store}, but below: {known}; name one.*DENTINE__SERVER__STORES.*\.$",
    ):
        ServerStores(ServerSettings(stores=allowed)).require(spec(store))


def test_an_open_server_takes_none_either_before_it_looks_for_anything(tmp_path: Path) -> None:
    jobs = Jobs(ServerSettings(data=tmp_path / "data", access="open"), lambda *_: None)
    with pytest.raises(SettingsError, match="Option 'store'"):
        jobs.submit(JobSpec(capture=tmp_path, store="s3://teeth/lab"))
    jobs.repository.close()


def test_a_setting_that_is_no_store() -> None:
    with pytest.raises(SettingsError, match=r"DENTINE__SERVER__STORES: http://x/teeth is no s3://BUCKET/PREFIX"):
        ServerStores(ServerSettings(stores="s3://teeth, http://x/teeth"))


def test_a_setting_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    ServerStores(ServerSettings())
    with pytest.raises(PlatformError, match=r"install dentine\[s3\]"):
        ServerStores(ServerSettings(stores="s3://teeth"))


def test_what_is_deleted_is_gone_there_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Published results and remains of an attempt are deleted; while the store does not answer, they stay noted."""
    (tmp_path / "capture").mkdir()
    write_folder(tmp_path / "capture")

    def cut_off(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(object_store, "RETRIES", 0)
    with s3_server() as server:
        use(monkeypatch, server.endpoint)
        prepare(tmp_path / "capture", tmp_path / "published", store=f"s3://{BUCKET}/lab")
        with monkeypatch.context() as patch:
            patch.setattr(AttemptFiles, "seal", cut_off)
            with pytest.raises(KeyboardInterrupt):
                prepare(tmp_path / "capture", tmp_path / "begun", store=f"s3://{BUCKET}/lab")
        others = len(server.objects())
        server.before = lambda *_: "503 Service Unavailable"
        with pytest.raises(StoreError, match="does not answer"):
            erase(tmp_path / "published")
        assert (tmp_path / "published" / "prepared" / "prepared.zarr").is_file()
        server.before = lambda *_: None
        assert erase(tmp_path / "published").files > 0
        assert 0 < len(server.objects()) < others
        erase(tmp_path / "begun")
        assert not server.objects()
        assert not (tmp_path / "published").exists()
