"""The dashboard's bundle is in the wheel, and a server without it says so in its page."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from services.api import app as app_module
from services.api.app import STATIC, UNBUILT, create_app
from services.core.settings import ServerSettings
from tests.support.installed import build_wheel
from tests.support.live_server import serving

BUNDLE = ("app.js", "app.css", "eventWorker.js")


@pytest.mark.parametrize("is_built", [True, False])
def test_the_first_page_is_never_blank(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_built: bool) -> None:
    monkeypatch.setattr(app_module, "is_dashboard_built", lambda: is_built)
    with serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)) as client:
        page = client.get("/")
        assert page.status_code == 200
        assert ("make dashboard" in page.text) is not is_built
        if not is_built:
            assert client.get("/page.css").headers["content-type"].startswith("text/css")


def test_the_wheel_contains_the_page(tmp_path: Path) -> None:
    wheel = build_wheel(
        tmp_path, {f"services/api/dashboard/static/{name}": "" for name in BUNDLE if not (STATIC / name).exists()}
    )
    names = set(zipfile.ZipFile(wheel).namelist())
    of_page = [*(STATIC / name for name in (*BUNDLE, "index.html", "icon.svg")), *UNBUILT.iterdir()]
    folder = Path(app_module.__file__).parents[2]
    assert {str(path.relative_to(folder)) for path in of_page} <= names
    assert not [name for name in names if "node_modules" in name]
