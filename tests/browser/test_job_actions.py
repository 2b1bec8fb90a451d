"""Actions on a job in the page: name, download, retry, delete."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from services.api.app import create_app
from services.core.errors import CaptureInputError
from services.core.settings import ServerSettings
from tests.browser.pages import LOOKS, looked_at, watched_page
from tests.browser.scripted_job import STEPS, ScriptedJob, submit
from tests.support.live_server import serving

pytestmark = pytest.mark.browser


@pytest.fixture
def job() -> ScriptedJob:
    return ScriptedJob()


@pytest.fixture
def page(chromium: Browser, tmp_path: Path, job: ScriptedJob) -> Iterator[Page]:
    with serving(create_app(ServerSettings(data=tmp_path / "data"), job)) as client:
        with watched_page(chromium, str(client.base_url).rstrip("/"), *LOOKS[1], expected=("409",)) as page:
            yield page
        job.steps.release(STEPS)


def test_a_job_is_named_downloaded_and_deleted(page: Page, job: ScriptedJob, tmp_path: Path) -> None:
    job.steps.release(2 * STEPS)
    older, newer = submit(page), submit(page)
    page.goto(f"/#/{newer}")
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    page.get_by_role("button", name="Name…").click()
    page.get_by_label("A label for people").fill("  Anna, upper left  ")
    looked_at(page, "name")
    page.keyboard.press("Enter")
    expect(page.locator(".job h2")).to_have_text("Job 2 · Anna, upper left")
    expect(page.locator(f"#jobs a[href='#/{newer}'] .name")).to_have_text("Anna, upper left")

    with page.expect_download() as download:
        page.get_by_role("link", name="Download all (zip)").click()
    download.value.save_as(tmp_path / "files.zip")
    assert download.value.suggested_filename == f"dentine-{newer}.zip"
    with zipfile.ZipFile(tmp_path / "files.zip") as archive:
        assert {"report.html", "parameters.json"} <= set(archive.namelist())

    with page.expect_download() as download:
        page.get_by_role("link", name="As a table for a spreadsheet (CSV)").click()
    download.value.save_as(tmp_path / "parameters.csv")
    assert download.value.suggested_filename == f"dentine-{newer}.csv"
    assert f"{newer},green,enamel.sigma,4.0321,0.0512,1/mm,true" in (tmp_path / "parameters.csv").read_text()
    looked_at(page, "parameters")

    page.get_by_role("button", name="Delete…").click()
    dialog = page.get_by_role("dialog", name="Delete job 2, “Anna, upper left”?")
    expect(dialog).to_contain_text("files that can be downloaded")
    expect(dialog).to_contain_text("The capture that it was made from stays.")
    looked_at(page, "delete")
    page.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    assert page.request.get(f"/v1/jobs/{newer}").ok

    page.get_by_role("button", name="Delete…").click()
    page.get_by_role("button", name="Delete for good").click()
    expect(page.locator(f"#jobs a[href='#/{newer}']")).to_have_count(0)
    expect(page.locator(".job h2")).to_have_text("Job 1")
    assert page.url.endswith(f"#/{older}")
    assert page.request.get(f"/v1/jobs/{newer}").status == 404
    assert not (tmp_path / "data" / "jobs" / newer).exists()


def test_a_failed_job_is_retried_and_one_under_way_offers_no_deletion(page: Page, job: ScriptedJob) -> None:
    job.problem = CaptureInputError("Frame c0_l3.npy is missing; copy it there.")
    job.steps.release()
    page.goto(f"/#/{submit(page)}")
    expect(page.locator(".job .badge")).to_have_text("failed")
    job.problem = None
    page.get_by_role("button", name="Retry").click()
    expect(page.locator(".job .badge")).to_have_text("running")
    expect(page.get_by_role("button", name="Delete…")).to_be_hidden()
    expect(page.get_by_role("button", name="Cancel")).to_be_visible()
    job.steps.release(STEPS)
    expect(page.locator(".job .badge")).to_have_text("succeeded")


def test_what_the_server_refuses_is_told(page: Page, job: ScriptedJob) -> None:
    job.steps.release(STEPS)
    number = submit(page)
    page.goto(f"/#/{number}")
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    page.get_by_role("button", name="Delete…").click()
    refusal = {"detail": "A job that is RUNNING does not take 'delete'; it takes cancel."}
    page.route(f"**/v1/jobs/{number}", lambda route: route.fulfill(status=409, json=refusal), times=1)
    page.get_by_role("button", name="Delete for good").click()
    expect(page.get_by_role("alert")).to_have_text("A job that is RUNNING does not take 'delete'; it takes cancel.")
