"""One database has one owner: the data folder of the server that used it first, also where it lies in that folder."""

from __future__ import annotations

from pathlib import Path

import pytest
import sqlalchemy as sql
from pydantic import SecretStr

from services.api.app import create_app
from services.api.data_folder import FILE, data_folder_table
from services.core.errors import SettingsError
from services.core.settings import DATABASE_FILE, ServerSettings
from services.pipeline.database import open_database
from tests.support.live_server import serving


def run_nothing(*_: object) -> None:
    """Run a job that succeeds at once."""


def serve(settings: ServerSettings) -> None:
    """Serve for a moment."""
    with serving(create_app(settings, run_nothing)) as client:
        assert client.get("/v1/jobs").status_code == 200


def test_a_second_server_is_refused_the_database_of_the_first(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    serve(ServerSettings(data=first))
    url = f"sqlite:///{first / DATABASE_FILE}"
    with pytest.raises(SettingsError, match=f"belongs to another data folder than {second}"):
        create_app(ServerSettings(data=second, database=SecretStr(url)), run_nothing)
    engine = open_database(url)
    with engine.connect() as connection:
        owners = connection.scalars(sql.select(data_folder_table.c.id)).all()
    engine.dispose()
    assert owners == [(first / FILE).read_text().strip()], "the refused server wrote its identity"
    serve(ServerSettings(data=first))


def test_a_folder_that_was_moved_with_its_database_is_served_on(tmp_path: Path) -> None:
    serve(ServerSettings(data=tmp_path / "first"))
    (tmp_path / "first").rename(tmp_path / "moved")
    serve(ServerSettings(data=tmp_path / "moved"))
