"""The first steps of a new user: an empty page leads to the demonstration's report or to a rig, and the form follows
the schema of jobs.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, Page, expect

from services.api.app import create_app
from services.core.records import JobSpec
from services.core.settings import DomeSettings, ServerSettings
from tests.browser.pages import looked_at, watched_page
from tests.support.calibration_jobs import publish_calibration
from tests.support.guarded_server import run_nothing
from tests.support.live_server import serving
from tests.support.toy_stages import run_here
from tests.support.uploading import contents_of, upload_capture, write_capture

pytestmark = pytest.mark.browser


@pytest.fixture
def server(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[httpx.Client]:
    dome = DomeSettings(address=getattr(request, "param", None))
    with serving(create_app(ServerSettings(data=tmp_path / "data", dome=dome), run_nothing)) as client:
        yield client


def address_of(server: httpx.Client) -> str:
    return str(server.base_url).rstrip("/")


def test_an_empty_page_leads_to_the_report_in_three_clicks(chromium: Browser, tmp_path: Path) -> None:
    with (
        serving(create_app(ServerSettings(data=tmp_path / "data"), run_here)) as server,
        watched_page(chromium, address_of(server)) as page,
    ):
        page.goto("/")
        expect(page.get_by_role("heading", name="New job")).to_be_visible()
        looked_at(page, "empty")
        clicks = [page.get_by_role("button", name="Run the demo"), page.get_by_role("link", name="Open the report")]
        assert len(clicks) <= 3
        clicks[0].click()
        expect(page.locator(".job h2")).to_have_text("Job 1 · Demonstration")
        expect(page.locator(".stages li strong")).to_have_text(["phantom", "capture", "prepare", "fit", "export"])
        expect(page.locator(".job .badge")).to_have_text("succeeded")
        looked_at(page, "demo")
        with page.context.expect_page() as opened:
            clicks[1].click()
        expect(opened.value).to_have_title("report")
        page.get_by_role("link", name="New job").click()  # the first steps stay reachable when there are jobs
        expect(page.get_by_role("button", name="Run the demo")).to_be_visible()
        expect(page.locator("#new")).to_have_attribute("aria-current", "page")


def test_what_the_demonstration_is_refused_for_is_told(chromium: Browser, server: httpx.Client) -> None:
    with watched_page(chromium, address_of(server), expected=("507",)) as page:
        page.goto("/")
        page.route(
            "**/v1/jobs",
            lambda route: (
                route.fulfill(status=507, json={"detail": "2 workers need more memory."})
                if route.request.method == "POST"
                else route.fallback()
            ),
        )
        page.get_by_role("button", name="Run the demo").click()
        expect(page.get_by_role("alert")).to_have_text("2 workers need more memory.")


@pytest.mark.parametrize("server", ["simulated"], indirect=True)
def test_a_rig_is_explained_and_its_dome_is_looked_at(chromium: Browser, server: httpx.Client) -> None:
    with watched_page(chromium, address_of(server)) as page:
        page.goto("/")
        page.get_by_role("link", name="Connect a rig").click()
        expect(page.locator(".rig [role=status]")).to_have_text(
            re.compile(r"The dome at simulated.* answers: 155 lights, firmware .+\.")
        )
        looked_at(page, "rig")
        page.get_by_role("link", name="Submit a job with a rig").click()
        expect(page.get_by_label("What is fitted from")).to_have_value("rig")


def test_calibrations_are_shown_with_their_state_and_offered_to_jobs(
    chromium: Browser, server: httpx.Client, tmp_path: Path
) -> None:
    tree = json.loads((write_capture(tmp_path / "mine") / "capture.json").read_text())
    del tree["images"]
    limit = {"what": "scatter of corners, camera c0", "value": 1.5, "limit": 1.0, "unit": "px"}
    made = {"made": datetime.now(UTC).isoformat(), "valid_days": 30.0}
    server.put("/v1/calibrations/new-rig", json=tree | made | {"limits": []}).raise_for_status()
    server.put("/v1/calibrations/shaken-rig", json=tree | made | {"limits": [limit]}).raise_for_status()
    server.put("/v1/calibrations/old-rig", json=tree | made | {"made": "2020-01-01T00:00:00"}).raise_for_status()
    with watched_page(chromium, address_of(server), expected=("404",)) as page:
        page.goto("/#/rig")
        rows = page.get_by_role("region", name="Calibrations").locator("tbody tr")
        expect(rows.filter(has_text="new-rig")).to_contain_text("good")
        expect(rows.filter(has_text="shaken-rig")).to_contain_text("beyond its limits")
        expect(rows.filter(has_text="shaken-rig")).to_contain_text("camera c0 is 1.5 px, and 1 px is the limit")
        expect(rows.filter(has_text="old-rig")).to_contain_text("It was made to hold for 30 days")
        looked_at(page, "calibrations")
        page.goto("/#/submit")
        offered = page.locator("#known-option-calibration option")
        expect(offered).to_have_count(3)
        expect(page.locator("#known-option-calibration option[value='calibrations/new-rig']")).to_have_text(
            "new-rig: good"
        )


def test_what_a_calibration_job_made_is_kept_from_its_page(chromium: Browser, tmp_path: Path) -> None:
    folder = write_capture(tmp_path / "session")
    tree = json.loads((folder / "capture.json").read_text())
    del tree["images"]
    (folder / "calibration.json").write_text(json.dumps(tree))
    with serving(create_app(ServerSettings(data=tmp_path / "data"), publish_calibration)) as server:
        job = server.post("/v1/jobs", json={"kind": "calibration", "capture": str(folder)}).json()["id"]
        server.get(f"/v1/jobs/{job}/events")
        with watched_page(chromium, address_of(server)) as page:
            page.goto(f"/#/{job}")
            page.get_by_role("button", name="Keep the calibration…").click()
            page.get_by_label("Its name").fill("rig 1")
            page.keyboard.press("Enter")
            assert server.get("/v1/calibrations").json() == [], "a blank is no part of a name"
            page.get_by_label("Its name").fill("rig-1")
            looked_at(page, "keep-calibration")
            page.keyboard.press("Enter")
            expect(page.locator(".actions [role=status]")).to_have_text(
                "Jobs name it as calibrations/rig-1. Its state: not known."
            )
            looked_at(page, "kept-calibration")
        assert [one["name"] for one in server.get("/v1/calibrations").json()] == ["rig-1"]


def test_a_server_without_a_dome_says_so(chromium: Browser, server: httpx.Client) -> None:
    with watched_page(chromium, address_of(server), expected=("404",)) as page:
        page.goto("/#/rig")
        expect(page.locator(".rig [role=status]")).to_contain_text("DENTINE__SERVER__DOME__ADDRESS")


def submitted(server: httpx.Client, page: Page) -> dict[str, Any]:
    expect(page.locator(".job h2")).to_be_visible()
    job: dict[str, Any] = server.get("/v1/jobs").json()["jobs"][0]
    return job


def test_the_form_is_the_schema_and_submits_what_was_changed(
    chromium: Browser, server: httpx.Client, tmp_path: Path
) -> None:
    uploaded = upload_capture(server, contents_of(write_capture(tmp_path / "mine")))
    with watched_page(chromium, address_of(server)) as page:
        page.goto(f"/#/submit/{uploaded}")
        expect(page.get_by_label("What is fitted from")).to_have_value("capture")
        expect(page.get_by_label("Capture", exact=True)).to_have_value(uploaded)
        shown = {
            name.removeprefix("option-")
            for name in page.locator("details [id^=option-]").evaluate_all("all => all.map(one => one.id)")
        }
        shown = {name for name in shown if not name.endswith(("-help", "-wrong"))}
        assert shown == set(JobSpec.model_fields) - {"capture", "rig"}

        page.get_by_label("Preset").select_option("quick")
        expect(page.locator("#option-pixel_step")).to_have_value("3")
        page.get_by_label("Preset").select_option("accurate")
        expect(page.locator("#option-pixel_step")).to_have_value("auto")
        for group in page.locator("details").all():
            group.evaluate("group => group.open = true")
        looked_at(page, "form")
        page.get_by_label("Name of the job").fill("Anna")
        page.get_by_label("Dentin").select_option("known")
        page.get_by_label("Lobes").select_option("2")
        expect(page.locator("#option-roughness-help")).to_contain_text("; 0.02 to 1.")
        page.get_by_label("Roughness").fill("0.2")
        page.get_by_label("Held out lights").fill("l1")
        page.get_by_label("Held", exact=True).fill("enamel.sigma = 4.5\nenamel.alpha = 0.99")
        page.get_by_label("Advise").uncheck()
        page.get_by_role("button", name="Submit the job").click()
        job = submitted(server, page)
    changed = JobSpec.model_validate(job["spec"])
    asked = {
        "capture": f"captures/{uploaded}",
        "samples_per_pixel": 128,
        "max_samples_per_pixel": 4096,
        "max_steps": 24,
        "search_candidates": 200000,
    }
    asked |= {
        "dentin": "known",
        "lobes": 2,
        "roughness": 0.2,
        "held_out_lights": ["l1"],
        "held": {"enamel.sigma": 4.5, "enamel.alpha": 0.99},
        "advise": False,
    }
    assert changed == JobSpec.model_validate(asked)
    assert job["name"] == "Anna"


def test_the_demonstration_brings_the_options_that_its_capture_needs(chromium: Browser, server: httpx.Client) -> None:
    with watched_page(chromium, address_of(server)) as page:
        page.goto("/#/submit")
        source = page.get_by_label("What is fitted from")
        expect(source).to_have_value("demo")
        expect(page.get_by_label("Boundary")).to_have_value("matched")
        source.select_option("rig")
        expect(page.get_by_label("Boundary")).not_to_have_value("matched")
        page.get_by_label("Index of refraction").fill("1.6")
        source.select_option("capture")
        expect(page.get_by_label("Index of refraction")).to_have_value("1.6")
        source.select_option("demo")
        page.get_by_label("Preset").select_option("quick")
        expect(page.get_by_label("Boundary")).to_have_value("matched")
        page.get_by_role("button", name="Submit the job").click()
        job = submitted(server, page)
    preset = {name: server.get(f"/v1/presets/{name}").json()["options"] for name in ("demo", "quick")}
    assert JobSpec.model_validate(job["spec"]) == JobSpec.model_validate(preset["quick"] | preset["demo"])


def test_what_is_wrong_stands_beside_its_field(chromium: Browser, server: httpx.Client, tmp_path: Path) -> None:
    upload_capture(server, contents_of(write_capture(tmp_path / "mine")))
    with watched_page(chromium, address_of(server), expected=("422",)) as page:
        page.goto("/#/submit")
        page.get_by_label("Index of refraction").fill("7")
        page.get_by_role("button", name="Submit the job").click()
        wrong = page.locator("#option-ior-wrong")
        expect(wrong).to_contain_text("3")  # the browser's own words: it must be 3 or less
        expect(page.get_by_label("Index of refraction")).to_be_focused()
        page.get_by_label("Index of refraction").fill("1.6")
        expect(wrong).to_have_text("")
        page.locator("details", has_text="Solver").last.evaluate("group => group.open = true")
        page.get_by_label("Held", exact=True).fill("enamel.colour = 3")
        page.locator("details", has_text="Solver").last.evaluate("group => group.open = false")
        page.get_by_role("button", name="Submit the job").click()
        expect(page.get_by_role("alert").filter(has_text="enamel.colour")).to_be_visible()
    assert server.get("/v1/jobs").json()["jobs"] == []


def test_a_rig_is_submitted_with_its_options(chromium: Browser, server: httpx.Client, tmp_path: Path) -> None:
    mouth = write_capture(tmp_path / "mouth")
    with watched_page(chromium, address_of(server), expected=("422",)) as page:
        page.goto("/#/submit/rig")
        page.get_by_role("button", name="Submit the job").click()
        expect(page.get_by_label("Mouth")).to_be_focused()
        page.get_by_label("Mouth").fill("/nowhere")
        page.get_by_role("button", name="Submit the job").click()
        expect(page.locator("#option-rig-mouth-wrong")).to_contain_text(
            "/nowhere does not exist on the server; upload it"
        )
        page.get_by_label("Mouth").fill(str(mouth))
        page.get_by_label("Exposure, s", exact=True).fill("0.02")
        page.get_by_role("button", name="Submit the job").click()
        job = submitted(server, page)
    assert (job["spec"]["rig"]["mouth"], job["spec"]["rig"]["exposure_s"], job["spec"]["rig"]["dome"]) == (
        str(mouth),
        0.02,
        "simulated",
    )
