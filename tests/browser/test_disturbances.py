"""The dashboard while the server refuses, answers late or is unreachable: the page shows the true state, and recovers
by itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from services.api.app import STATIC, create_app
from services.core.settings import ServerSettings
from tests.browser.scripted_job import STEPS, ScriptedJob, submit
from tests.support.live_server import serving

pytestmark = pytest.mark.browser

LOST = "Connection lost; trying again."
COUNTING = """
delete window.SharedWorker;  // its stream is out of a test's reach; the page then holds the same one itself
window.streams = [];
window.EventSource = class extends EventSource {
  constructor(...given) { super(...given); window.streams.push(this); }
};
window.listeners = 0;
for (const [name, change] of [["addEventListener", 1], ["removeEventListener", -1]]) {
  const native = EventTarget.prototype[name];
  MediaQueryList.prototype[name] = function (...given) { window.listeners += change; native.apply(this, given); };
}
"""
OPEN_STREAMS = "streams.filter(stream => stream.readyState !== EventSource.CLOSED).length"


@pytest.fixture
def job() -> ScriptedJob:
    return ScriptedJob()


@pytest.fixture
def page(chromium: Browser, tmp_path: Path, job: ScriptedJob) -> Iterator[Page]:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    with serving(create_app(ServerSettings(data=tmp_path / "data"), job)) as client:
        page = chromium.new_page(base_url=str(client.base_url))
        broken: list[str] = []
        page.on("pageerror", lambda problem: broken.append(str(problem)))
        page.add_init_script(COUNTING)
        yield page
        page.context.close()
        job.steps.release(2 * STEPS)
    assert not broken


def refuse(route: Route, status: int, detail: str) -> None:
    route.fulfill(status=status, json={"detail": detail})


def await_refresh(page: Page) -> None:
    """Wait until the page has requested the list again and has had time to show the answer."""
    with page.expect_response(lambda answer: "/v1/jobs?" in answer.url):
        pass
    page.evaluate("new Promise(requestAnimationFrame)")


def test_a_refused_event_stream_is_opened_anew_and_counts_as_lost_until_then(page: Page) -> None:
    job_id = submit(page)
    page.route("**/v1/events?*", lambda route: refuse(route, 503, "Not now."))
    page.goto(f"/#/{job_id}")
    expect(page.locator("#connection")).to_have_text(LOST)
    await_refresh(page)
    expect(page.locator("#connection")).to_have_text(LOST)
    page.unroute("**/v1/events?*")
    expect(page.locator("#connection")).to_have_text("")
    note = page.locator(".stages li", has_text="prepare").locator(".note")
    expect(note).to_have_text("24 images prepared.")
    assert page.evaluate(OPEN_STREAMS) == 1
    replayed = {
        "id": 1,
        "job": job_id,
        "attempt": 1,
        "stage": "prepare",
        "kind": "log",
        "message": "Told again.",
        "done": None,
        "data": {},
    }
    page.evaluate(
        "event => streams.at(-1).dispatchEvent(new MessageEvent('message', {data: JSON.stringify(event)}))", replayed
    )
    expect(note).to_have_text("24 images prepared.")


def test_a_refused_stream_is_not_opened_anew_for_a_view_that_was_left(page: Page) -> None:
    first, second = submit(page), submit(page)
    page.route(f"**/v1/events?job={first}:*", lambda route: refuse(route, 503, "Not now."))
    page.goto(f"/#/{first}")
    expect(page.locator("#connection")).to_have_text(LOST)
    page.locator(f"#jobs a[href='#/{second}']").click()
    expect(page.locator(".job h2")).to_have_text("Job 2")
    expect(page.locator("#connection")).to_have_text("")
    page.wait_for_function("job => streams.at(-1).url.includes(job)", arg=second)  # opened a moment after the view
    opened = page.evaluate("streams.length")
    for _ in range(2):
        await_refresh(page)
    assert page.evaluate("streams.length") == opened


def test_the_newest_job_is_followed_by_one_stream(page: Page) -> None:
    submit(page)
    page.goto("/")
    expect(page.locator(".job .badge")).to_have_text("running")
    await_refresh(page)
    assert page.evaluate("streams.length") == 1


@pytest.mark.parametrize("is_refused", [False, True], ids=["answer", "refusal"])
def test_a_late_answer_leaves_the_view_that_was_opened_since(page: Page, is_refused: bool) -> None:
    first, second = submit(page), submit(page)
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    page.route(f"**/v1/jobs/{first}", hold)
    page.goto(f"/#/{first}")
    while not held:  # the page sends the request when one of its lanes is free
        page.wait_for_timeout(20)
    page.locator(f"#jobs a[href='#/{second}']").click()
    expect(page.locator(".job h2")).to_have_text("Job 2")
    with page.expect_response(f"**/v1/jobs/{first}"):
        if is_refused:
            refuse(held[0], 500, "The database is away.")
        else:
            held[0].continue_()
    await_refresh(page)
    expect(page.locator(".job h2")).to_have_text("Job 2")
    expect(page.get_by_role("alert")).to_have_count(0)
    assert page.evaluate("streams.map(stream => new URL(stream.url).search)") == [f"?job={second}:0"]


def test_a_view_that_is_left_lets_go_of_its_curve(page: Page, job: ScriptedJob) -> None:
    first = submit(page)
    job.steps.release()
    page.goto(f"/#/{first}")
    expect(page.locator(".chart canvas")).to_be_visible()
    second = submit(page)  # only now, because jobs run concurrently and it might have taken the first job's step
    expect(page.locator(f"#jobs a[href='#/{second}']")).to_be_visible()
    chart = page.evaluate_handle("document.querySelector('.chart')")
    listeners = page.evaluate("listeners")
    page.locator(f"#jobs a[href='#/{second}']").click()
    expect(page.locator(".job h2")).to_have_text("Job 2")
    assert page.evaluate("listeners") == listeners
    assert chart.evaluate("chart => chart.querySelector('.uplot')") is None
    page.wait_for_function("job => streams.at(-1).url.includes(job)", arg=second)  # opened a moment after the view
    assert page.evaluate(OPEN_STREAMS) == 1


def test_what_fails_at_the_start_is_asked_again(page: Page) -> None:
    job_id = submit(page)
    page.route(f"**/v1/jobs/{job_id}", lambda route: refuse(route, 503, "The database is away."), times=1)
    page.route("**/v1/session", lambda route: refuse(route, 429, "Too many requests."), times=1)
    page.route("**/artifacts", lambda route: route.abort())
    page.goto(f"/#/{job_id}")
    expect(page.get_by_role("alert")).to_have_text("The database is away. Trying again.")
    expect(page.get_by_role("link", name="Dome")).to_be_hidden()
    expect(page.locator(".job .badge")).to_have_text("running")
    expect(page.get_by_role("link", name="Dome")).to_be_visible()
    expect(page.get_by_role("alert")).to_have_text("The server cannot be reached.")
    page.unroute("**/artifacts")
    expect(page.get_by_role("alert")).to_have_count(0)


def test_a_job_that_is_not_there_is_asked_for_once(page: Page) -> None:
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto("/#/0123456789ab")
    expect(page.get_by_role("alert")).to_contain_text("0123456789ab")
    for _ in range(2):
        await_refresh(page)
    assert sum(url.endswith("/v1/jobs/0123456789ab") for url in asked) == 1


def test_the_connection_is_lost_only_where_nobody_answers(page: Page) -> None:
    page.route("**/v1/jobs?*", lambda route: refuse(route, 429, "Too many requests; wait 7 s."))
    page.goto("/")
    expect(page.locator("#connection")).to_have_text("Too many requests; wait 7 s.")
    page.unroute("**/v1/jobs?*")
    page.route("**/v1/jobs?*", lambda route: route.abort())
    expect(page.locator("#connection")).to_have_text(LOST)
    page.unroute("**/v1/jobs?*")
    expect(page.locator("#connection")).to_have_text("")
    expect(page.get_by_text("No job yet")).to_be_visible()
