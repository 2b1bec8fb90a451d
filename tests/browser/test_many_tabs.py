"""Many pages of one browser, which opens at most six connections to a server: they share one stream of events, and ALL
OFF is always answered.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, Route, expect

from services.api.app import STATIC, create_app
from services.api.auth.tokens import Scope
from services.capture.dome.simulator import simulated_dome
from services.core.settings import DomeSettings, ServerSettings
from tests.browser.chromium import PATIENCE_MS
from tests.browser.pages import looked_at
from tests.browser.scripted_job import STEPS, ScriptedJob, submit
from tests.support.guarded_server import guarded
from tests.support.live_server import serving

pytestmark = pytest.mark.browser

LIGHTS = 155
TABS = 8
CONNECTIONS, LANES = 6, 3
"""Number of connections that Chromium opens to one server, and number of them for the pages' requests (lanes.ts)."""
DOWNLOADS = (
    "job => { for (let n = 0; n < 12; n++) void fetch(`/v1/jobs/${job}/artifacts.zip?n=${n}`).catch(() => {}); }"
)
HIDE = """hidden => {
  Object.defineProperty(document, "hidden", {value: hidden, configurable: true});
  document.dispatchEvent(new Event("visibilitychange"));
}"""


@dataclass
class Bench:
    """A server with a simulated dome, its open event streams, and downloads that hang."""

    address: str
    job: ScriptedJob
    streams: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    """Open requests of pages, without streams and those over the connection of ALL OFF."""
    most_asked: int = 0
    go_on: threading.Event = field(default_factory=threading.Event)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    bench = Bench("", ScriptedJob())
    with simulated_dome(LIGHTS, 10.0) as (host, port):
        settings = ServerSettings(
            data=tmp_path_factory.mktemp("data"),
            dome=DomeSettings(address=f"{host}:{port}", watchdog_s=10.0),
            jobs_at_once=TABS,
        )
        app = create_app(settings, bench.job)

        async def counting(scope: Any, receive: Any, send: Any) -> None:
            asked, path = scope.get("query_string", b"").decode(), scope.get("path", "")
            by_page = any(name == b"sec-fetch-mode" for name, _ in scope.get("headers", ())) and path.startswith("/v1/")
            is_of_all_off = path in {"/v1/dome/off", "/v1/health/live"}
            under_way = (
                bench.streams if path.endswith("/events") else bench.asked if by_page and not is_of_all_off else []
            )
            under_way.append(asked)
            bench.most_asked = max(bench.most_asked, len(bench.asked))
            try:
                await app(scope, receive, send)
            finally:
                under_way.remove(asked)

        with serving(counting) as client:
            bench.address = str(client.base_url)
            yield bench
            bench.go_on.set()
            bench.job.steps.release(3 * TABS * STEPS)


@pytest.fixture
def context(chromium: Browser, bench: Bench) -> Iterator[BrowserContext]:
    context = chromium.new_context(base_url=bench.address, viewport={"width": 1280, "height": 900})
    broken: list[str] = []
    context.on("weberror", lambda problem: broken.append(str(problem.error)))
    yield context
    context.request.post("/v1/dome/off")
    context.close()
    assert not broken


def dome_page(context: BrowserContext) -> Page:
    page = context.new_page()
    page.goto("/#/dome")
    expect(page.locator(".dome .badge")).to_contain_text("dark")
    return page


def light_up(page: Page) -> None:
    page.get_by_label("Seconds").fill("30")
    page.get_by_role("button", name="Light 3", exact=True).click()
    expect(page.locator(".dome .badge")).to_have_text("light 3 is on")


def until(page: Page, condition: Any) -> None:
    waited_ms = 0
    while not condition():
        assert waited_ms < PATIENCE_MS, "waited in vain"
        page.wait_for_timeout(20)
        waited_ms += 20


@pytest.mark.dear("Eight pages are more than the connections that a browser opens to one server.")
def test_eight_job_pages_are_live_by_one_stream_and_all_off_answers(context: BrowserContext, bench: Bench) -> None:
    dome = dome_page(context)
    light_up(dome)
    bench.most_asked = 0
    tabs = [context.new_page() for _ in range(TABS)]
    jobs = [submit(dome) for _ in tabs]
    for tab, job in zip(tabs, jobs, strict=True):
        tab.goto(f"/#/{job}")
    for tab in tabs:
        expect(tab.locator(".job h2")).to_contain_text("Job ")
    until(dome, lambda: len(bench.streams) == 1 and all(job in bench.streams[0] for job in jobs))
    dome.locator(".all-off").click()
    expect(dome.locator(".done")).to_have_text("All is dark. No job was capturing.")
    expect(dome.locator(".dome .badge")).to_have_text("dark, ALL OFF")
    bench.job.steps.release(TABS * STEPS)
    for tab in tabs:
        expect(tab.locator(".job .badge")).to_have_text("succeeded")
        expect(tab.locator(".stages li", has_text="prepare").locator(".note")).to_have_text("24 images prepared.")
        expect(tab.locator(".chart figcaption")).to_contain_text(f"{STEPS} steps.")
    until(dome, lambda: not bench.streams)
    assert 1 <= bench.most_asked <= LANES, (
        "what pages ask together leaves connections for the stream, an upload and ALL OFF"
    )


def test_a_hidden_page_follows_nothing_and_catches_up_when_it_is_shown(context: BrowserContext, bench: Bench) -> None:
    page = context.new_page()
    job = submit(page)
    page.goto(f"/#/{job}")
    until(page, lambda: len(bench.streams) == 1)
    expect(page.locator(".job .badge")).to_have_text("running")  # so that the page's first request of the job is over
    page.evaluate(HIDE, arg=True)
    until(page, lambda: not bench.streams)
    bench.job.steps.release(STEPS)
    until(page, lambda: page.request.get(f"/v1/jobs/{job}").json()["state"] == "SUCCEEDED")
    assert page.locator(".job .badge").text_content() != "succeeded"
    page.evaluate(HIDE, arg=False)
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    expect(page.locator(".chart figcaption")).to_contain_text(f"{STEPS} steps.")


def test_the_connection_of_all_off_stays_open(context: BrowserContext) -> None:
    """The server closes an idle connection after 5 s, and on a busy machine accepts a new one late."""
    dome = dome_page(context)
    dome.wait_for_timeout(6000)
    dome.locator(".all-off").click()
    expect(dome.locator(".done")).to_have_text("All is dark. No job was capturing.")
    connecting_ms = dome.evaluate(
        "performance.getEntriesByType('resource').filter(sent => sent.name.endsWith('/v1/dome/off'))"
        ".map(sent => sent.connectEnd - sent.connectStart)"
    )
    assert connecting_ms == [0], "ALL OFF had to connect"


def test_all_off_is_answered_while_every_connection_is_held(
    context: BrowserContext, monkeypatch: pytest.MonkeyPatch, bench: Bench
) -> None:
    """Long downloads hold the connections. On a server without tokens, ALL OFF is sent over a connection of its own."""
    dome = dome_page(context)
    light_up(dome)
    asked: list[str] = []

    def hang(*_: object) -> list[object]:
        asked.append("")
        bench.go_on.wait(60)
        return []

    monkeypatch.setattr("services.api.jobs.history_routes.list_artifacts", hang)
    job = submit(dome)
    dome.evaluate(DOWNLOADS, job)
    until(dome, lambda: len(asked) == CONNECTIONS)
    dome.locator(".all-off").click()
    expect(dome.locator(".done")).to_have_text("All is dark. No job was capturing.")
    assert len(asked) == CONNECTIONS, "a connection was free after all"
    assert dome.request.get("/v1/dome").json()["status"]["stopped"]
    bench.go_on.set()


def test_all_off_of_a_session_is_answered_while_every_connection_is_held(
    chromium: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Requests with the page's cookie share the six connections with downloads; ALL OFF is sent without the cookie."""
    asked, go_on = [], threading.Event()

    def hang(*_: object) -> list[object]:
        asked.append("")
        go_on.wait(60)
        return []

    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    monkeypatch.setattr("services.api.jobs.history_routes.list_artifacts", hang)
    with simulated_dome(LIGHTS, 10.0) as (host, port):
        dome = DomeSettings(address=f"{host}:{port}", watchdog_s=10.0)
        with guarded(tmp_path, dome=dome) as server:
            context = chromium.new_context(base_url=str(server.client.base_url))
            page = context.new_page()
            page.goto("/#/dome")
            page.get_by_label("Token").fill(server.tokens[Scope.ADMIN])
            page.keyboard.press("Enter")
            expect(page.locator(".dome .badge")).to_contain_text("dark")
            light_up(page)
            job = server.ask("POST", "/v1/jobs", Scope.ADMIN, json={"capture": "/"}).json()["id"]
            page.evaluate(DOWNLOADS, job)
            until(page, lambda: len(asked) == CONNECTIONS)
            page.locator(".all-off").click()
            expect(page.locator(".done")).to_have_text("All is dark. No job was capturing.")
            assert len(asked) == CONNECTIONS, "a connection was free after all"
            go_on.set()
            context.close()


def test_an_all_off_without_an_answer_is_told_in_red_after_a_second(context: BrowserContext) -> None:
    dome = dome_page(context)
    light_up(dome)
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    dome.route("**/v1/dome/off", hold)
    trouble = dome.locator(".off-trouble")
    expect(trouble).to_be_hidden()
    dome.locator(".all-off").click()
    expect(trouble).to_be_visible()
    expect(trouble).to_have_text(
        "ALL OFF has had no answer for 1 s; it is still being sent. Press the dome's emergency stop, or cut its power."
    )
    assert trouble.evaluate("one => getComputedStyle(one).color") == dome.evaluate(
        "() => { const one = document.createElement('i'); one.style.color = 'var(--bad)'; document.body.append(one);"
        " return getComputedStyle(one).color; }"
    )
    looked_at(dome, "dome-off-unanswered")
    held[0].continue_()
    expect(dome.locator(".done")).to_have_text("All is dark. No job was capturing.")
    expect(trouble).to_be_hidden()
    dome.unroute("**/v1/dome/off")
    dome.route("**/v1/dome/off", lambda route: route.abort())
    dome.locator(".all-off").click()
    expect(dome.get_by_role("alert")).to_have_text(
        "ALL OFF was not carried out: The server cannot be reached. Press the dome's emergency stop, or cut its power."
    )


def test_a_state_of_the_dome_that_is_old_is_told_with_its_age(context: BrowserContext) -> None:
    dome = dome_page(context)
    heard, state = dome.locator(".heard"), dome.locator(".dome .badge")
    expect(heard).to_have_text("last heard 0 s ago")
    light_up(dome)
    dome.route("**/v1/dome", lambda _: None)  # neither answered nor refused
    expect(heard).to_contain_text(" s ago: light 3 is on")
    expect(state).to_have_text("unknown")
    expect(dome.locator(".lights [aria-pressed]")).to_have_count(0)
    looked_at(dome, "dome-stale")
    dome.unroute_all(behavior="ignoreErrors")
    expect(state).to_have_text("light 3 is on")
    expect(heard).to_have_text("last heard 0 s ago")
