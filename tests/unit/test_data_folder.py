"""A server starts only with a database and a data folder that belong together."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pydantic import SecretStr

from services.api.data_folder import FILE
from services.api.jobs.jobs import Jobs
from services.core.errors import SettingsError
from services.core.settings import ServerSettings
from services.pipeline.database import sqlite_url


@pytest.fixture
def shared(tmp_path: Path) -> SecretStr:
    """A database beside the data folders."""
    return SecretStr(sqlite_url(tmp_path / "shared.sqlite"))


def start(data: Path, database: SecretStr | None) -> None:
    Jobs(ServerSettings(data=data, database=database), lambda *_: None).repository.close()


def test_a_server_with_another_data_folder_does_not_start(tmp_path: Path, shared: SecretStr) -> None:
    start(tmp_path / "a", shared)
    start(tmp_path / "a", shared)
    for _ in range(2):
        with pytest.raises(SettingsError, match=r"belongs to another data folder than .*/b"):
            start(tmp_path / "b", shared)
    start(tmp_path / "a", shared)


def test_a_folder_and_its_database_start_where_both_were_restored(tmp_path: Path, shared: SecretStr) -> None:
    start(tmp_path / "a", shared)
    shutil.copytree(tmp_path / "a", tmp_path / "restored" / "a")
    shutil.copy(tmp_path / "shared.sqlite", tmp_path / "restored" / "shared.sqlite")
    start(tmp_path / "restored" / "a", SecretStr(sqlite_url(tmp_path / "restored" / "shared.sqlite")))


def test_whoever_has_lost_the_folder_goes_on_as_the_refusal_says(tmp_path: Path, shared: SecretStr) -> None:
    start(tmp_path / "lost", shared)
    with pytest.raises(SettingsError, match=f"write [0-9a-f]{{16}} into .*{FILE} if that folder is lost") as refused:
        start(tmp_path / "new", shared)
    words = refused.value.message.split()
    (tmp_path / "new" / FILE).write_text(words[words.index("write") + 1])
    start(tmp_path / "new", shared)


def test_a_database_that_was_copied_into_a_data_folder_belongs_to_it(tmp_path: Path) -> None:
    start(tmp_path / "a", None)
    (tmp_path / "b").mkdir()
    shutil.copy(tmp_path / "a" / "dentine.sqlite", tmp_path / "b")
    start(tmp_path / "b", None)
    with pytest.raises(SettingsError, match="belongs to another data folder"):
        start(tmp_path / "c", SecretStr(sqlite_url(tmp_path / "b" / "dentine.sqlite")))
    start(tmp_path / "b", None)
    start(tmp_path / "a", None)
