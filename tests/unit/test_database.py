"""Errors of a database that does not answer."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import sqlalchemy as sql

from services.pipeline.database import Query, open_database, retry_while_lost, sqlite_url, writing


def test_a_file_that_cannot_be_opened_is_an_error_that_is_waited_out(tmp_path: Path) -> None:
    folder, query = tmp_path / "data", Query(sql.select(sql.literal(1).label("one")))
    engine = open_database(sqlite_url(folder / "some.sqlite"))
    shutil.rmtree(folder)
    with pytest.raises(sql.exc.OperationalError, match="unable to open"):
        query.rows(engine)
    tries = iter([lambda: None, folder.mkdir])

    def ask() -> object:
        next(tries)()
        return query.rows(engine)

    assert retry_while_lost(ask) == [(1,)]
    engine.dispose()


def test_a_writer_gives_up_on_one_of_its_own_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.pipeline.database.WRITER_WAIT_S", 0.01)
    engine = open_database(sqlite_url(tmp_path / "some.sqlite"))
    with writing(engine), pytest.raises(sql.exc.OperationalError, match="have not ended"), writing(engine):
        pass
    with writing(engine) as connection:
        connection.execute(sql.select(1))
    engine.dispose()
