"""The dashboard in a real browser on the real API: live updates, keyboard, contrast, no requests to other servers."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from playwright.sync_api import Browser, Page, expect

from services.api.app import STATIC, create_app
from services.api.jobs.repository import Repository
from services.core.errors import CaptureInputError, DiskFullError
from services.core.records import JobSpec
from services.core.settings import ServerSettings
from services.core.stage import StageEvent
from services.pipeline.database import sqlite_url
from services.pipeline.event_log import EventLog
from tests.browser.contrast import contrast_failures
from tests.browser.pages import looked_at
from tests.browser.scripted_job import STEPS, ScriptedJob, expect_state, submit
from tests.support.live_server import serving
from tests.support.past_runs import remember_runs
from tests.support.uploading import write_capture

pytestmark = pytest.mark.browser


@pytest.fixture
def job() -> ScriptedJob:
    return ScriptedJob()


@pytest.fixture
def page(chromium: Browser, tmp_path: Path, job: ScriptedJob) -> Iterator[Page]:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    with serving(create_app(ServerSettings(data=tmp_path / "data"), job)) as client:
        context = chromium.new_context(base_url=str(client.base_url), viewport={"width": 1280, "height": 1000})
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


def test_an_address_that_names_nothing_says_so_until_a_job_is_chosen(page: Page) -> None:
    submit(page)
    page.goto("/#/jobs/nothing")
    expect(page.get_by_role("alert")).to_have_text("No job has the address #/jobs/nothing; choose one from the list.")
    page.locator("#jobs a").click()
    expect(page.locator(".job .badge")).to_be_visible()
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_job_is_followed_live_to_its_result(page: Page, job: ScriptedJob) -> None:
    submit(page)
    page.goto("/")
    expect(page.locator(".job .badge")).to_have_text("running")
    expect(page.locator(".stages li", has_text="prepare").locator(".state")).to_have_text("finished")
    expect(page.locator("#workers")).to_contain_text(
        "Workers start with the next job. Done: 0 in the last hour, 0 in 24 h."
    )
    expect(page.locator(".remaining")).to_have_text(
        "No time range: The size of its capture cannot be read, so it cannot be compared with other jobs."
    )
    for step in range(STEPS - 1):
        job.steps.release()
        expect(page.locator(".chart figcaption")).to_contain_text(f"{step + 1} steps.")
    expect(page.locator(".chart figcaption")).to_contain_text("± 1.2 %; red: loss")
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
    # Sources are shares of the squared ± (the gain's is 0.04² / 0.0512²); those below a twentieth are left out.
    expect(page.locator("tr", has_text="enamel.sigma").first.locator(".sources").first).to_have_text(
        "gain 61 %, photographs 38 %"
    )
    expect(page.locator("tr", has_text="dentin.g1").first).to_contain_text("not determined")
    expect(page.get_by_role("link", name="report.html")).to_be_visible()
    expect(page.get_by_role("link", name="Open the report")).to_be_visible()
    looked_at(page, "dashboard")


def test_a_failure_says_what_to_do_and_can_be_retried_by_keyboard(page: Page, job: ScriptedJob) -> None:
    submit(page)
    page.goto("/")
    job.problem = CaptureInputError("Frame c0_l3.npy is missing; copy it there.")
    job.steps.release()
    expect(page.get_by_role("alert")).to_have_text("fit: Frame c0_l3.npy is missing; copy it there.")
    job.problem = None
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


def test_the_skip_link_leads_to_the_content_and_leaves_the_view(page: Page) -> None:
    job_id = submit(page)
    page.goto(f"/#/{job_id}")
    expect(page.locator(".job .badge")).to_have_text("running")
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to the content")).to_be_focused()
    page.keyboard.press("Enter")
    expect(page.locator("#main")).to_be_focused()
    page.evaluate("location.hash = '#main'")
    expect(page).to_have_url(re.compile("#main$"))
    expect(page.locator(".job .badge")).to_have_text("running")
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_stage_that_was_begun_is_stopped_while_its_job_waits(page: Page, job: ScriptedJob) -> None:
    job_id = submit(page)
    page.goto(f"/#/{job_id}")
    fit = page.locator(".stages li", has_text="fit").locator(".state")
    expect(fit).to_have_text("running")
    job.problem = DiskFullError("The disk was full; free some space.")
    job.steps.release()
    expect(page.locator(".job .badge")).to_have_text("queued")
    expect(fit).to_have_text("stopped")
    page.reload()
    expect(fit).to_have_text("stopped")
    stages = page.request.get(f"/v1/jobs/{job_id}").json()["stages"]
    assert [(stage["stage"], stage["state"]) for stage in stages] == [
        ("prepare", "finished"),
        ("fit", "stopped"),
        ("export", "waiting"),
    ]
    job.problem = None


def test_single_teeth_of_a_jaw_are_named_and_give_way_to_the_whole_jaw(
    page: Page, job: ScriptedJob, tmp_path: Path
) -> None:
    job_id = submit(page)
    page.goto(f"/#/{job_id}")
    expect(page.locator(".stages li", has_text="fit").locator(".state")).to_have_text("running")
    repository = Repository(sqlite_url(tmp_path / "data" / "dentine.sqlite"))
    log = EventLog(repository.engine, job_id)

    def tell(step: int, channel: str, tooth: int | None, **parameters: float) -> None:
        data = {"channel": channel, "step": step, "loss": 0.5**step, "tooth": tooth, "parameters": parameters}
        log.append(1, StageEvent(stage="fit", kind="step", data=data))

    caption, head = page.locator(".chart figcaption"), page.locator(".scroll thead th")
    tell(1, "green", 11, **{"enamel.sigma": 4.0})
    expect(caption).to_contain_text("1 steps. green, tooth 11: loss 0.5.")
    tell(2, "green", 12, **{"enamel.sigma": 5.0, "enamel.alpha": 0.9})
    expect(caption).to_contain_text("1 steps. green, tooth 12: loss 0.25.")
    expect(head).to_have_text(["parameter", "unit", "green, tooth 12"])
    tell(3, "green", None, **{"0.enamel.sigma": 6.0, "cavity.reflectance": 0.3})
    tell(3, "red", 11, **{"enamel.sigma": 7.0})
    tell(4, "red", None, **{"0.enamel.sigma": 8.0})
    expect(caption).to_contain_text("2 steps. green: loss 0.125; red: loss 0.0625.")
    expect(head).to_have_text(["parameter", "unit", "green", "red"])
    expect(page.locator(".scroll tr", has_text="0.enamel.sigma").locator("td")).to_have_text(["mm⁻¹", "6", "8"])
    expect(page.locator(".scroll tr", has_text="cavity.reflectance").locator("td")).to_have_text(["", "0.3", "–"])
    expect(page.locator(".scroll tbody tr")).to_have_count(2)
    repository.close()


def test_a_job_fits_a_phone_however_long_its_names_are(page: Page, job: ScriptedJob, tmp_path: Path) -> None:
    page.set_viewport_size({"width": 375, "height": 800})
    name = "-".join(["incisor"] * 12)
    (tmp_path / name).mkdir()
    job_id = submit(page, str(tmp_path / name))
    page.goto(f"/#/{job_id}")
    expect(page.locator(".stages li", has_text="fit").locator(".state")).to_have_text("running")
    (tmp_path / "data" / "jobs" / job_id / f"{name}.json").touch()
    job.steps.release(STEPS - 1)
    expect(page.locator(".chart figcaption")).to_contain_text("5 steps.")
    repository = Repository(sqlite_url(tmp_path / "data" / "dentine.sqlite"))
    pictures = dict.fromkeys(("render", "photo", "residual"), "previews/0-photo.png")
    data = {"camera": name, "light": name, "channel": "green", "step": 0, "held_out": True} | pictures
    EventLog(repository.engine, job_id).append(
        1, StageEvent(stage="fit", kind="preview", message=f"{name}.", data=data)
    )
    repository.close()
    page.get_by_label("Picture").select_option(f"green · {name} · {name} (held out)")
    expect(page.locator(".stack .over")).to_have_attribute("alt", f"Render: camera {name}, light {name}, step 0")
    job.problem = CaptureInputError(f"Frame {tmp_path / name} is missing; copy it there.")
    job.steps.release()
    expect(page.get_by_role("alert")).to_be_visible()
    expect(page.locator(".files a", has_text=name)).to_be_visible()
    expect(page.locator(".chart canvas")).to_be_visible()
    keep_picture(page, "phone")
    assert page.evaluate("document.documentElement.scrollWidth") <= 375


def keep_picture(page: Page, name: str) -> None:
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=f"{folder}/dashboard-{name}.png", full_page=True)


@pytest.mark.dear("A thousand jobs are drawn without a graphics processor.")
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


def test_a_queued_job_says_what_it_waits_for(page: Page, job: ScriptedJob, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=2**28, total=2**50))
    monkeypatch.setattr("services.api.jobs.runner.ROUND_S", 0.2)
    number = submit(page)
    page.goto(f"/#/{number}")
    expect(page.locator(".job header + p + p")).to_have_text(
        re.compile(r"Waits for disk: about [0-9.]+ GiB are needed and [0-9.]+ GiB are free\.")
    )
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
    expect(page.locator(".remaining")).to_have_text(
        re.compile(r"Ends in \d+ to \d+ min: 80 % range from 5 past jobs\.")
    )
    assert contrast_failures(page) == []
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=f"{folder}/remaining.png", full_page=True)
    job.steps.release(STEPS)
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    expect(page.locator(".remaining")).to_be_hidden()
