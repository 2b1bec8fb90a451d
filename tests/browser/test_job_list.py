"""The list of jobs in a real browser: older jobs are loaded on demand, without gaps or repetitions, and are kept up to
date like newer ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from services.api.app import STATIC, create_app
from services.api.jobs.repository import Repository
from services.api.tables.lifecycle import Trigger
from services.core.records import JobSpec
from services.core.settings import DATABASE_FILE, ServerSettings
from services.pipeline.database import sqlite_url
from tests.support.live_server import serving

pytestmark = pytest.mark.browser

PAGE = 50


@pytest.fixture
def page(chromium: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    monkeypatch.setattr(
        "services.api.jobs.runner.ROUND_S", 600.0
    )  # jobs that a test writes into the database stay queued
    with serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)) as client:
        page = chromium.new_page(base_url=str(client.base_url))
        broken: list[str] = []
        page.on("pageerror", lambda problem: broken.append(str(problem)))
        yield page
        page.context.close()
    assert not broken


@pytest.fixture
def repository(page: Page, tmp_path: Path) -> Iterator[Repository]:
    repository = Repository(sqlite_url(tmp_path / DATABASE_FILE))
    yield repository
    repository.close()


@pytest.fixture
def create(repository: Repository) -> Callable[[int], list[str]]:
    return lambda count: [repository.create(JobSpec(capture=Path("/")), None).job.id for _ in range(count)]


def expect_numbers(page: Page, newest: int, oldest: int) -> None:
    expect(page.locator("#jobs strong")).to_have_text([f"Job {number}" for number in range(newest, oldest - 1, -1)])


def test_older_jobs_stay_in_line_while_new_ones_come(page: Page, create: Callable[[int], list[str]]) -> None:
    create(2 * PAGE + 20)
    page.goto("/")
    expect_numbers(page, 120, 71)
    page.get_by_role("button", name="Older jobs").evaluate("button => { button.click(); button.click(); }")
    expect_numbers(page, 120, 21)
    create(3)
    expect_numbers(page, 123, 21)
    page.get_by_role("button", name="Older jobs").click()
    expect_numbers(page, 123, 1)
    expect(page.get_by_role("button", name="Older jobs")).to_be_hidden()
    create(2)
    expect_numbers(page, 125, 1)
    expect(page.get_by_role("button", name="Older jobs")).to_be_hidden()


def test_older_jobs_change_their_state_and_go_when_they_are_deleted(
    page: Page, repository: Repository, create: Callable[[int], list[str]]
) -> None:
    jobs = create(PAGE + 10)
    page.goto("/")
    page.get_by_role("button", name="Older jobs").click()
    expect(page.locator("#jobs a")).to_have_count(PAGE + 10)
    old = page.locator(f"#jobs a[href='#/{jobs[4]}']")
    expect(old.locator(".badge")).to_have_text("queued")
    repository.apply(jobs[4], Trigger.CANCEL)
    expect(old.locator(".badge")).to_have_text("cancelled")
    assert page.request.delete(f"/v1/jobs/{jobs[4]}").ok
    expect(old).to_have_count(0)
    expect(page.locator("#jobs a")).to_have_count(PAGE + 9)


def test_a_failed_question_for_older_jobs_is_told_and_can_be_repeated(
    page: Page, create: Callable[[int], list[str]]
) -> None:
    create(PAGE + 1)
    page.goto("/")
    expect(page.locator("#jobs a")).to_have_count(PAGE)
    page.route(
        "**/v1/jobs?*before=*",
        lambda route: route.fulfill(status=429, json={"detail": "Too many requests; wait 7 s."}),
        times=1,
    )
    page.get_by_role("button", name="Older jobs").click()
    expect(page.locator("#jobs").get_by_role("alert")).to_have_text("Too many requests; wait 7 s.")
    page.get_by_role("button", name="Older jobs").click()
    expect_numbers(page, 51, 1)
    expect(page.get_by_role("alert")).to_have_count(0)


def test_the_list_takes_no_focus_from_elsewhere(page: Page, create: Callable[[int], list[str]]) -> None:
    (job,) = create(1)
    worker = {
        "name": "1",
        "host": "here",
        "tasks": [{"stage": "fit", "job": job}],
        "memory_bytes": 1,
        "memory_limit_bytes": None,
    }
    told = {"workers": [worker], "sentence": "1 worker.", "succeeded_last_hour": 0, "succeeded_last_day": 0}
    page.route("**/v1/workers", lambda route: route.fulfill(json=told))
    page.goto("/")
    page.locator("#workers a").focus()
    create(1)
    expect_numbers(page, 2, 1)
    expect(page.locator("#workers a")).to_be_focused()
    page.locator(f"#jobs a[href='#/{job}']").focus()
    create(1)
    expect_numbers(page, 3, 1)
    expect(page.locator(f"#jobs a[href='#/{job}']")).to_be_focused()
