"""The setup link in a real browser: it makes the token, signs in, and is refused the second time."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from services.api.app import create_app
from services.api.auth.setup_links import SetupLinks
from services.core.settings import ServerSettings
from services.pipeline.database import open_database
from tests.browser.pages import LOOKS, looked_at, watched_page
from tests.support.guarded_server import run_nothing
from tests.support.live_server import serving

pytestmark = pytest.mark.browser


@pytest.fixture
def server(tmp_path: Path) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path, access="tokens"), run_nothing)) as client:
        yield client


@pytest.fixture
def link(server: httpx.Client, tmp_path: Path) -> str:
    engine = open_database(ServerSettings(data=tmp_path).database_url)
    secret = SetupLinks(engine).issue()
    engine.dispose()
    assert secret is not None
    return f"/#/setup/{secret.get_secret_value()}"


@pytest.mark.dear("It starts the browser and a server of its own.")
def test_a_setup_link_works_once(chromium: Browser, server: httpx.Client, link: str) -> None:
    address = str(server.base_url).rstrip("/")
    with watched_page(chromium, address, *LOOKS[1]) as page:
        page.goto(link)
        expect(page.locator("#jobs")).to_be_hidden()
        looked_at(page, "setup")
        page.get_by_role("button", name="Make the administrator's token").click()
        token = page.locator(".token").inner_text()
        expect(page.get_by_role("button", name="Run the demo")).to_be_visible()
        looked_at(page, "setup-done")
        assert "setup" not in page.url
        assert server.get("/v1/tokens", headers={"Authorization": f"Bearer {token}"}).status_code == 200
        page.get_by_role("link", name="New job").click()
        expect(page.locator(".token")).to_be_visible()  # until its owner says that it is stored
        page.get_by_role("button", name="I have kept it").click()
        expect(page.locator(".token")).to_have_count(0)
        expect(page.locator("#account")).to_contain_text("administrator")
        expect(page.locator("#jobs")).to_be_visible()
        assert page.evaluate("[document.cookie, localStorage.length, sessionStorage.length]") == ["", 0, 0]
        page.reload()
        expect(page.locator("#account")).to_contain_text("administrator")
        expect(page.locator(".token")).to_have_count(0)
    with watched_page(chromium, address, *LOOKS[1], expected=("403",)) as page:
        page.goto(link)
        page.get_by_role("button", name="Make the administrator's token").click()
        expect(page.get_by_role("alert")).to_contain_text("This setup link was used, has expired or is unknown")
        expect(page.locator(".token")).to_have_count(0)
