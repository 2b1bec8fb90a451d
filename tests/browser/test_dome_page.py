"""The dome's page in a real browser, on a simulated dome: ALL OFF and lights by keyboard, preflight, contrast."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from services.api.app import STATIC, create_app
from services.capture.dome.simulator import simulated_dome
from services.core.settings import DomeSettings, ServerSettings
from tests.browser.contrast import contrast_failures
from tests.browser.pages import looked_at
from tests.support.live_server import serving
from tests.support.mouth import write_mouth

pytestmark = pytest.mark.browser
LIGHTS = 155


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    data = tmp_path_factory.mktemp("data")
    with simulated_dome(LIGHTS, 10.0) as (host, port):
        settings = ServerSettings(data=data, dome=DomeSettings(address=f"{host}:{port}", watchdog_s=10.0))
        with serving(create_app(settings, lambda *_: None)) as client:
            yield str(client.base_url)


@pytest.fixture
def page(chromium: Browser, server: str) -> Iterator[Page]:
    context = chromium.new_context(base_url=server, viewport={"width": 1280, "height": 1000})
    page = context.new_page()
    broken: list[str] = []
    page.on("pageerror", lambda problem: broken.append(str(problem)))
    page.on(
        "console",
        lambda message: (
            broken.append(message.text) if message.type == "error" and "Failed to load" not in message.text else None
        ),
    )
    page.goto("/")
    page.get_by_role("link", name="Dome").click()
    yield page
    page.request.post("/v1/dome/off")
    context.close()
    assert not broken


def keep_picture(page: Page, name: str) -> None:
    if folder := os.environ.get("SCREENSHOTS"):
        page.screenshot(path=f"{folder}/{name}.png", full_page=True)


def test_a_light_and_all_off_by_keyboard(page: Page) -> None:
    state, lights = page.locator(".dome .badge"), page.locator(".lights button")
    expect(state).to_contain_text("dark")
    expect(lights).to_have_count(LIGHTS)
    expect(page.get_by_role("alert")).to_have_count(0)
    assert contrast_failures(page) == []

    page.locator(".all-off").focus()
    for _ in range(4):  # level, seconds, switch-off button, lights
        page.keyboard.press("Tab")
    expect(lights.first).to_be_focused()
    page.keyboard.press("ArrowDown")
    below = int(page.evaluate("document.activeElement.textContent"))
    assert 1 < below < LIGHTS, "the light below the first is in the next row"
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Enter")
    expect(state).to_have_text(f"light {below - 1} is on")
    expect(lights.nth(below - 1)).to_have_attribute("aria-pressed", "true")
    assert page.request.get("/v1/dome").json()["status"]["lit"] == [below - 1]
    looked_at(page, "dome-light")

    page.locator(".all-off").focus()
    page.keyboard.press("Enter")
    expect(state).to_have_text("dark, ALL OFF")
    expect(page.locator(".done")).to_have_text("All is dark. No job was capturing.")
    expect(page.locator(".lights [aria-pressed=true]")).to_have_count(0)
    told = page.request.get("/v1/dome").json()["status"]
    assert (told["lit"], told["stopped"]) == ([], True)
    looked_at(page, "dome-off")


def test_a_light_goes_dark_by_itself_and_no_longer_time_is_asked_for(page: Page) -> None:
    page.get_by_label("Seconds").fill("31")
    page.get_by_role("button", name="Light 3", exact=True).click()
    expect(page.locator("#seconds:invalid")).to_be_focused()
    assert page.request.get("/v1/dome").json()["status"]["lit"] == []
    page.get_by_label("Seconds").fill("1")
    page.get_by_role("button", name="Light 3", exact=True).click()
    expect(page.locator(".dome .badge")).to_have_text("light 3 is on")
    expect(page.locator(".dome .badge")).to_have_text("dark")


def test_a_preflight_tells_what_it_found_or_why_it_cannot(page: Page, tmp_path: Path) -> None:
    folder = page.get_by_label("Folder of the rig on the server")
    folder.fill(str(tmp_path / "absent"))
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("absent does not exist on the server; check the path.")
    assert contrast_failures(page) == []
    write_mouth(tmp_path, lights=4)
    folder.fill(str(tmp_path))
    page.get_by_role("button", name="Run the preflight").click()
    expect(page.locator(".findings li")).to_have_text(["All is well."])
    expect(page.get_by_role("alert")).to_be_hidden()


def test_nothing_is_shown_as_known_while_the_dome_does_not_answer(page: Page) -> None:
    state, third = page.locator(".dome .badge"), page.get_by_role("button", name="Light 3", exact=True)
    page.get_by_label("Seconds").fill("30")
    third.click()
    expect(state).to_have_text("light 3 is on")
    page.route(
        "**/v1/dome",
        lambda route: route.fulfill(status=502, json={"detail": "The dome does not answer; check its cable."}),
    )
    expect(page.get_by_role("alert")).to_have_text("The dome does not answer; check its cable.")
    expect(state).to_have_text("unknown")
    expect(page.locator(".lights [aria-pressed]")).to_have_count(0)
    expect(page.locator(".facts dt")).to_have_count(0)
    expect(third).to_be_focused()
    assert contrast_failures(page) == []
    keep_picture(page, "dome-unknown")
    page.unroute("**/v1/dome")
    expect(state).to_have_text("light 3 is on")
    expect(third).to_have_attribute("aria-pressed", "true")
    expect(page.locator(".facts dt")).not_to_have_count(0)
    expect(page.get_by_role("alert")).to_have_count(0)


def test_all_is_dark_is_told_no_longer_than_it_is_true(page: Page) -> None:
    page.locator(".all-off").click()
    expect(page.locator(".done")).to_have_text("All is dark. No job was capturing.")
    answer = page.request.put("/v1/dome/light", data={"light": 3, "level": 0.05, "on_s": 30})
    assert answer.ok, answer.text()
    expect(page.locator(".dome .badge")).to_have_text("light 3 is on")
    expect(page.locator(".done")).to_be_hidden()


def test_a_state_that_was_asked_for_before_all_off_is_not_shown_after_it(page: Page) -> None:
    page.get_by_role("button", name="Light 3", exact=True).click()
    expect(page.locator(".dome .badge")).to_have_text("light 3 is on")
    before = page.request.get("/v1/dome").json()
    held: list[Route] = []

    def hold(route: Route) -> None:
        held.append(route)

    page.route("**/v1/dome", hold, times=1)
    while not held:
        page.wait_for_timeout(50)
    page.locator(".all-off").click()
    expect(page.locator(".done")).to_be_visible()
    with page.expect_response("**/v1/dome"):
        held[0].fulfill(json=before)
    page.evaluate("new Promise(requestAnimationFrame)")
    assert page.locator(".dome .badge").text_content() == "dark, ALL OFF"
    assert page.locator(".done").is_visible()


def test_the_link_to_the_capturing_job_keeps_the_focus(page: Page) -> None:
    def capture(route: Route) -> None:
        state = route.fetch().json()
        route.fulfill(json=state | {"capturing": ["0123456789ab"], "others_capturing": 2})

    page.route("**/v1/dome", capture)
    link = page.get_by_role("link", name="0123456789ab")
    link.focus()
    for _ in range(2):
        with page.expect_response("**/v1/dome"):
            pass
    page.evaluate("new Promise(requestAnimationFrame)")
    expect(link).to_be_focused()
    told = "The dome captures, so no light goes on by hand. Job 0123456789ab and 2 jobs of others."
    expect(page.get_by_text(told)).to_be_visible()
    looked_at(page, "dome-captures")
    page.unroute_all(behavior="ignoreErrors")
    expect(link).to_have_count(0)


def test_the_dome_fits_a_phone(page: Page) -> None:
    page.set_viewport_size({"width": 375, "height": 800})
    folder = page.get_by_label("Folder of the rig on the server")
    folder.fill("/" + "-".join(["absent"] * 12))
    page.keyboard.press("Enter")
    expect(page.get_by_role("alert")).to_contain_text("does not exist on the server; check the path.")
    expect(page.locator(".lights button")).to_have_count(LIGHTS)
    keep_picture(page, "dome-phone")
    assert page.evaluate("document.documentElement.scrollWidth") <= 375


def test_a_server_without_a_dome_says_so(chromium: Browser, tmp_path: Path) -> None:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    with serving(create_app(ServerSettings(data=tmp_path), lambda *_: None)) as client:
        page = chromium.new_page(base_url=str(client.base_url))
        page.goto("/#/dome")
        expect(page.get_by_role("alert")).to_contain_text(
            "This server has no dome to work by hand; set DENTINE__SERVER__DOME__ADDRESS"
        )
        expect(page.locator(".all-off")).to_be_visible()
        page.close()
