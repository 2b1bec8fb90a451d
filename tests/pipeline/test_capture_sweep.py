"""The removal of expired captures continues after the database or the disk has failed once."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
import sqlalchemy as sql

from services.api.app import create_app
from services.api.captures.captures import Captures
from services.core.settings import ServerSettings
from tests.support.live_server import serving


def test_the_sweep_goes_on_after_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    faults, is_swept = (
        iter([sql.exc.OperationalError("SELECT", None, OSError("away")), PermissionError("locked")]),
        threading.Event(),
    )

    def sweep(_captures: Captures) -> None:
        if (fault := next(faults, None)) is not None:
            raise fault
        is_swept.set()

    monkeypatch.setattr(Captures, "sweep", sweep)
    monkeypatch.setattr("services.api.captures.routes.SWEEP_S", 0.0)
    with serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)):
        assert is_swept.wait(10)
    assert [record.message for record in caplog.records if "looking after captures" in record.message] == [
        "looking after captures failed; trying again in 0 s"
    ] * 2
