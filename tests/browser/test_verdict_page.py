"""The page shows a fit's quality in the report's words and numbers, the worst first, and shows at once that a job
waits.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Browser, expect

from services.api.app import create_app
from services.api.jobs.admission import Machine
from services.assets.report_page import _spread
from services.core.results import Estimate, FitReport
from services.core.settings import ServerSettings
from services.core.verdict import percent, verdict_of
from tests.browser.pages import looked_at, watched_page
from tests.browser.scripted_job import STEPS, ScriptedJob, expect_state, submit
from tests.support.live_server import serving

pytestmark = pytest.mark.browser

THICKNESS = Estimate(value=0.703, se=0.061, unit="mm", determined=True)


def report(error: float, *, converged: bool, doubtful: bool = False) -> FitReport:
    errors = {"green": error, "red": error + 0.02}
    advice = (
        ("red: unseen images are 9.4 % off beside their noise." if doubtful else "")
        if converged
        else "red: the images are still 35 % off; check mesh, lights and boundary model, or raise the samples."
    )
    told: dict[str, Any] = {
        "held_out_error": errors,
        "held_out_error_se": {"green": 0.0042, "red": 0.0051},
        "enamel_thickness": THICKNESS,
    }
    return FitReport(
        converged=converged,
        doubtful=doubtful,
        advice=advice,
        parameters={},
        fit_error=errors,
        steps=2 * STEPS,
        seconds=1.0,
        **told,
    )


@pytest.fixture(scope="module")
def job() -> ScriptedJob:
    return ScriptedJob()


@pytest.fixture(scope="module")
def server(job: ScriptedJob, tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path_factory.mktemp("data")), job)) as client:
        yield client
        job.steps.release(8 * STEPS)


def address_of(server: httpx.Client) -> str:
    return str(server.base_url).rstrip("/")


@pytest.mark.parametrize("outcome", ["converged", "doubtful", "not converged"])
def test_the_page_leads_with_the_reports_judgement(
    chromium: Browser, server: httpx.Client, job: ScriptedJob, outcome: str
) -> None:
    converged = outcome != "not converged"
    verdict = job.verdict = verdict_of(
        report(0.0741 if converged else 0.336, converged=converged, doubtful=outcome == "doubtful")
    )
    with watched_page(chromium, address_of(server)) as page:
        submitted = submit(page)
        page.goto(f"/#/{submitted}")
        job.steps.release(STEPS)
        word = "succeeded" if converged else outcome
        expect(page.locator(".job .badge")).to_have_text(word)
        expect(page.locator(f"#jobs a[href='#/{submitted}'] .badge")).to_have_text(word)
        shown = page.locator(".job .verdict")
        expect(shown.locator("dd strong").first).to_have_text(percent(verdict.error))
        expect(shown.locator("dd strong").last).to_have_text(_spread(THICKNESS))
        expect(shown).to_contain_text(
            f"green {percent(verdict.channels['green'])}, red {percent(verdict.channels['red'])}"
        )
        result = (
            f"Result: held-out error green {percent(verdict.channels['green'])}, red"
            f" {percent(verdict.channels['red'])}."
        )
        expect(page.locator(".chart figcaption")).to_contain_text(result)
        expect(page.locator(".comparison .scale")).to_contain_text("−25 % of white")
        expect(page.locator(".comparison .scale")).to_contain_text("+25 % of white")
        alert = page.get_by_role("alert")
        if outcome == "converged":
            expect(alert).to_have_count(0)
        else:
            expect(alert).to_have_text(f"{verdict.headline} {verdict.advice}")
            above = "(one, other) => Boolean(one.compareDocumentPosition(other) & Node.DOCUMENT_POSITION_FOLLOWING)"
            assert alert.evaluate(above, page.locator(".stages").element_handle()), "what went wrong leads the view"
        looked_at(page, f"verdict-{outcome.replace(' ', '-')}")


def test_a_job_without_a_verdict_shows_none(chromium: Browser, server: httpx.Client, job: ScriptedJob) -> None:
    job.verdict = None
    with watched_page(chromium, address_of(server)) as page:
        page.goto(f"/#/{submit(page)}")
        job.steps.release(STEPS)
        expect(page.locator(".job .badge")).to_have_text("succeeded")
        expect(page.locator(".job .verdict")).to_be_hidden()


def test_a_job_that_waits_for_disk_says_so_at_once(
    chromium: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, job: ScriptedJob
) -> None:
    """The page learns it by an event: it repeats its requests only after five seconds, and a round comes every ten."""
    monkeypatch.setattr("services.api.jobs.runner.ROUND_S", 3600.0)
    with (
        serving(create_app(ServerSettings(data=tmp_path), job)) as client,
        watched_page(chromium, address_of(client)) as page,
    ):
        page.clock.install()  # time stands still in the page, so that it repeats no request by itself
        full = Machine(free_disk_bytes=2**20, disk_bytes=2**40, memory_bytes=2**40)
        monkeypatch.setattr(Machine, "of", classmethod(lambda *_, **__: full))
        waiting = submit(page)
        page.goto(f"/#/{waiting}")
        page.clock.run_for(100)  # long enough to open the stream
        expect(page.locator(".job")).to_contain_text("Waits for disk: about 0.3 GiB are needed and 0.0 GiB are free.")
        looked_at(page, "waits-for-disk")
        events = client.get(f"/v1/jobs/{waiting}/logs").json()["lines"]
        assert [(line["stage"], line["message"].partition(":")[0]) for line in events] == [(None, "Waits for disk")]
        monkeypatch.undo()
        client.post(f"/v1/jobs/{waiting}/cancel").raise_for_status()
        expect_state(page, waiting, "CANCELLED")
