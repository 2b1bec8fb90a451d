"""The form says why a dome flashes slowly, and takes a person's acknowledgement of a faster plan."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import pytest
from playwright.sync_api import Browser, expect

from services.api.app import create_app
from services.core.records import JobSpec
from services.core.settings import DomeSettings, ServerSettings
from tests.browser.pages import looked_at, watched_page
from tests.support.guarded_server import run_nothing
from tests.support.live_server import serving

pytestmark = pytest.mark.browser
DOME = "dome.invalid:5020"


@pytest.fixture
def server(tmp_path: Path) -> Iterator[httpx.Client]:
    settings = ServerSettings(data=tmp_path / "data", dome=DomeSettings(job_addresses=DOME))
    with serving(create_app(settings, run_nothing)) as client:
        yield client


def test_a_faster_plan_is_acknowledged_in_the_form(chromium: Browser, server: httpx.Client) -> None:
    with watched_page(chromium, str(server.base_url).rstrip("/"), expected=("422",)) as page:
        page.goto("/#/submit/rig")
        page.locator("#option-rig-mouth").fill("/")
        page.locator("#option-rig-dome").fill(DOME)
        page.locator("summary", has_text="Flashes").click()
        expect(page.get_by_text("can trigger epileptic seizures")).to_be_visible()
        expect(page.get_by_text("goes dark by itself when not fed for this long; above 0, at most 60.")).to_be_visible()
        looked_at(page, "flashes")
        page.get_by_label("Flashes a second").fill("8")
        page.get_by_label("The eyes are covered").check()
        page.get_by_label("Name of who covered and asked").fill("B. Roe")
        page.get_by_role("button", name="Submit the job").click()
        expect(page.locator(".submit > .failure")).to_contain_text("rig.flashes.epilepsy_asked")
        page.get_by_label("Epilepsy was asked about").check()
        page.get_by_role("button", name="Submit the job").click()
        expect(page.locator(".job h2")).to_be_visible()
    spec = JobSpec.model_validate(server.get("/v1/jobs").json()["jobs"][0]["spec"])
    assert spec.rig is not None
    stated = spec.rig.flashes
    assert stated is not None
    assert (stated.per_s, stated.eye_cover, stated.epilepsy_asked, stated.by) == (8.0, True, True, "B. Roe")
    assert datetime.now(UTC) - stated.at < timedelta(minutes=5)
