"""The dashboard in a real browser on the real API: live updates, keyboard, contrast, and nothing asked of the network."""

from __future__ import annotations

import os
import re
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from services.api.app import STATIC, create_app
from services.api.database import sqlite_url
from services.api.events import EventAddress, EventLog
from services.api.repository import Repository
from services.core.errors import CaptureInputError
from services.core.records import Estimate, JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageEvent
from tests.browser.contrast import contrast_failures
from tests.support.live_server import serving
from tests.support.past_runs import remember_runs
from tests.support.uploading import write_capture

pytestmark = pytest.mark.browser

STEPS = 6


class ScriptedJob:
    """Reports what a fit reports, one step whenever the test lets it; the page cannot tell it from a fit."""

    def __init__(self) -> None:
        self.steps = threading.Semaphore(0)
        self.fails = False

    def __call__(self, _spec: JobSpec, folder: Path, events: EventAddress) -> None:
        with events.open() as log:
            prepare = log.begin_stage("prepare")
            log.append(prepare, StageEvent(stage="prepare", kind="finished", done=1.0, message="24 images prepared."))
            fit = log.begin_stage("fit")
            for step in range(STEPS):
                self.steps.acquire()
                if self.fails:
                    raise CaptureInputError("Frame c0_l3.npy is missing; copy it there.")
                self._report(log, fit, step, folder)
            log.append(fit, StageEvent(stage="fit", kind="finished", done=1.0, message="Converged after 6 steps."))
            export = log.begin_stage("export")
            table = {
                "enamel.sigma": Estimate(value=4.0321, se=0.0512, unit="1/mm", determined=True),
                "dentin.g1": Estimate(value=0.41, se=0.9, unit="1", determined=False),
            }
            (folder / "parameters.json").write_text("{" + ",".join(f'"{c}": {{{_json(table)}}}' for c in ("green", "red")) + "}")
            (folder / "report.html").write_text("<!doctype html><title>report</title>")
            log.append(export, StageEvent(stage="export", kind="finished", done=1.0))

    def _report(self, log: Any, attempt: int, step: int, folder: Path) -> None:
        for channel, factor in (("green", 1.0), ("red", 2.0)):
            data = {
                "channel": channel,
                "step": step,
                "loss": factor * 0.3**step,
                "held_out_error": factor * 0.4 * 0.5**step if step % 2 else None,
                "parameters": {"enamel.sigma": 4.0 + 0.01 * step},
            }
            log.append(attempt, StageEvent(stage="fit", kind="step", message=f"{channel} step {step}.", done=(step + 1) / STEPS, data=data))
        paths = {kind: f"previews/{step}-{kind}.png" for kind in ("render", "photo", "residual")}
        (folder / "previews").mkdir(exist_ok=True)
        for kind, path in paths.items():
            _write_picture(folder / path, kind, step)
        log.append(attempt, StageEvent(stage="fit", kind="preview", data={"camera": "c0", "light": "l3", "channel": "green", "step": step, **paths}))


def _json(table: dict[str, Estimate]) -> str:
    return ",".join(f'"{name}": {estimate.model_dump_json()}' for name, estimate in table.items())


def _write_picture(path: Path, kind: str, step: int) -> None:
    from PIL import Image

    y, x = np.mgrid[-1:1:60j, -1:1:48j]
    ball = np.sqrt(np.clip(1 - x**2 - y**2, 0, 1))
    grey = {"photo": ball, "render": ball ** (1 + 1 / (1 + step)), "residual": 0.5 + 0.1 * ball / (1 + step)}[kind]
    Image.fromarray((255 * grey).astype(np.uint8)).save(path)


@pytest.fixture
def job() -> ScriptedJob:
    return ScriptedJob()


@pytest.fixture
def page(chromium: Browser, tmp_path: Path, job: ScriptedJob, request: pytest.FixtureRequest) -> Iterator[Page]:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    scheme = getattr(request, "param", "light")
    with serving(create_app(ServerSettings(data=tmp_path / "data"), job)) as client:
        context = chromium.new_context(base_url=str(client.base_url), color_scheme=scheme, viewport={"width": 1280, "height": 1000})
        page = context.new_page()
        said: list[str] = []
        asked: list[str] = []
        page.on("console", lambda message: said.append(message.text) if message.type in {"error", "warning"} else None)
        page.on("pageerror", lambda problem: said.append(str(problem)))
        page.on("request", lambda request: asked.append(request.url))
        yield page
        context.close()
        job.steps.release(STEPS)
    assert not said
    assert all(url.startswith(str(client.base_url)) for url in asked)


def submit(page: Page) -> str:
    answer = page.request.post("/v1/jobs", data={"capture": "/"})
    assert answer.status == 201
    return str(answer.json()["id"])


def test_an_address_that_names_nothing_says_so_until_a_job_is_chosen(page: Page) -> None:
    submit(page)
    page.goto("/#/jobs/nothing")
    expect(page.get_by_role("alert")).to_have_text("No job has the address #/jobs/nothing; choose one from the list.")
    page.locator("#jobs a").click()
    expect(page.locator(".job .badge")).to_be_visible()
    expect(page.get_by_role("alert")).to_have_count(0)


@pytest.mark.parametrize("page", ["light", "dark"], indirect=True)
def test_a_job_is_followed_live_to_its_result(page: Page, job: ScriptedJob, request: pytest.FixtureRequest) -> None:
    submit(page)
    page.goto("/")
    expect(page.locator(".job .badge")).to_have_text("running")
    expect(page.locator(".stages li", has_text="prepare").locator(".state")).to_have_text("finished")
    expect(page.locator("#workers")).to_contain_text("Workers start with the next job. Done: 0 in the last hour, 0 in 24 h.")
    expect(page.locator(".remaining")).to_have_text("No time range: The size of its capture cannot be read, so it cannot be compared with other jobs.")
    for step in range(STEPS - 1):
        job.steps.release()
        expect(page.locator(".chart figcaption")).to_contain_text(f"{step + 1} steps.")
    expect(page.locator(".chart canvas")).to_be_visible()
    expect(page.locator(".comparison output")).to_have_text(str(STEPS - 2))
    expect(page.locator("td.number").first).to_have_text("4.04")
    page.locator("#picture-split").focus()
    for _ in range(10):
        page.keyboard.press("ArrowRight")
    assert page.locator(".stack .line").evaluate("line => line.style.left") == "60%"
    photo = page.locator(".stack img").first
    assert photo.evaluate("image => image.complete && image.naturalWidth") == 48

    job.steps.release()
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    expect(page.locator("tr", has_text="enamel.sigma").first).to_contain_text("4.032 ± 0.051")
    expect(page.locator("tr", has_text="dentin.g1").first).to_contain_text("not determined")
    expect(page.get_by_role("link", name="report.html")).to_be_visible()
    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    assert contrast_failures(page) == []
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=f"{folder}/dashboard-{request.node.callspec.params['page']}.png", full_page=True)


def test_a_failure_says_what_to_do_and_can_be_retried_by_keyboard(page: Page, job: ScriptedJob) -> None:
    submit(page)
    page.goto("/")
    job.fails = True
    job.steps.release()
    expect(page.get_by_role("alert")).to_have_text("fit: Frame c0_l3.npy is missing; copy it there.")
    job.fails = False
    page.get_by_role("button", name="Retry").focus()
    page.keyboard.press("Enter")
    expect(page.locator(".job .badge")).to_have_text("running")
    job.steps.release(STEPS)
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    expect(page.get_by_role("alert")).to_be_hidden()


def test_jobs_are_reached_by_keyboard_alone(page: Page, job: ScriptedJob) -> None:
    job.steps.release(2 * STEPS)
    first, second = submit(page), submit(page)
    page.goto("/")
    expect(page.locator("#jobs a")).to_have_count(2)
    expect(page).to_have_url(f"{page.url.split('#')[0]}#/{second}")
    reached = set()
    for _ in range(6):
        page.keyboard.press("Tab")
        reached.add(page.evaluate("document.activeElement.getAttribute('href')"))
        if f"#/{first}" in reached:
            break
    page.keyboard.press("Enter")
    expect(page.locator(".job h2")).to_have_text("Job 1")
    expect(page.locator("#jobs a[aria-current]")).to_have_attribute("href", f"#/{first}")


def test_a_thousand_jobs_and_five_hundred_steps_are_shown(page: Page, job: ScriptedJob, tmp_path: Path) -> None:
    repository = Repository(sqlite_url(tmp_path / "data" / "dentine.sqlite"))
    job.steps.release(STEPS)
    long = submit(page)
    expect_state(page, long, "SUCCEEDED")
    log = EventLog(repository.engine, long, lease=1)
    attempt = log.begin_stage("fit")
    for step in range(500):
        data = {"channel": "green", "step": step, "loss": 1 / (1 + step), "parameters": {}}
        log.append(attempt, StageEvent(stage="fit", kind="step", data=data))
    for seed in range(999):
        job.steps.release(STEPS)
        repository.create(JobSpec(capture=Path("/"), seed=seed), None)
    repository.close()
    page.goto(f"/#/{long}")
    expect(page.locator(".chart figcaption")).to_contain_text("500 steps.")
    expect(page.locator("#jobs a")).to_have_count(50)
    page.get_by_role("button", name="Older jobs").click()
    expect(page.locator("#jobs a")).to_have_count(100)


def expect_state(page: Page, job_id: str, state: str) -> None:
    while page.request.get(f"/v1/jobs/{job_id}").json()["state"] != state:
        time.sleep(0.05)


def test_a_queued_job_says_what_it_waits_for(page: Page, job: ScriptedJob, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2**28, total=2**50))
    monkeypatch.setattr("services.api.runner.ROUND_S", 0.2)
    number = submit(page)
    page.goto(f"/#/{number}")
    expect(page.locator(".job header + p + p")).to_have_text(re.compile(r"Waits for disk: about [0-9.]+ GiB are needed and [0-9.]+ GiB are free\."))
    assert contrast_failures(page) == []
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=f"{folder}/waiting.png", full_page=True)
    monkeypatch.undo()
    job.steps.release(STEPS)
    expect_state(page, number, "SUCCEEDED")
    expect(page.locator(".job header + p + p")).to_be_hidden()


def test_a_running_job_says_when_it_ends(page: Page, job: ScriptedJob, tmp_path: Path) -> None:
    capture = str(write_capture(tmp_path / "mine"))
    remember_runs(tmp_path / "data", capture, (900.0, 950.0, 1000.0, 1050.0, 1100.0))
    running = str(page.request.post("/v1/jobs", data={"capture": capture}).json()["id"])
    page.goto(f"/#/{running}")
    expect(page.locator(".remaining")).to_have_text(re.compile(r"Ends in \d+ to \d+ min: 80 % range from 5 past jobs\."))
    assert contrast_failures(page) == []
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=f"{folder}/remaining.png", full_page=True)
    job.steps.release(STEPS)
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    expect(page.locator(".remaining")).to_be_hidden()
