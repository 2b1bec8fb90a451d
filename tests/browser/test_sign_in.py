"""The dashboard on a server that requires tokens."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from services.api.app import STATIC
from services.api.auth.sessions import COOKIE
from services.api.auth.tokens import Scope
from services.core.errors import CaptureInputError
from services.core.records import JobSpec
from tests.browser.pages import looked_at
from tests.support.guarded_server import Guarded, guarded

pytestmark = pytest.mark.browser

FAILING_SEED = 2


def run(spec: JobSpec, *_: object) -> None:
    """Run a job that succeeds at once, or fails at once if its seed is ``FAILING_SEED``."""
    if spec.seed == FAILING_SEED:
        raise CaptureInputError("Frame c0_l3.npy is missing; copy it there.")


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Guarded]:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    with guarded(tmp_path, run) as server:
        server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/"})
        yield server


@pytest.fixture
def page(chromium: Browser, server: Guarded) -> Iterator[Page]:
    context = chromium.new_context(base_url=str(server.client.base_url), viewport={"width": 1280, "height": 700})
    page = context.new_page()
    broken: list[str] = []
    page.on("pageerror", lambda problem: broken.append(str(problem)))
    page.on(
        "console", lambda message: broken.append(message.text) if "Content Security Policy" in message.text else None
    )
    yield page
    context.close()
    assert not broken


def sign_in(page: Page, token: str) -> None:
    page.get_by_label("Token").fill(token)
    page.keyboard.press("Enter")


def test_a_token_opens_the_page_and_leaves_nothing_that_scripts_can_read(page: Page, server: Guarded) -> None:
    page.goto("/")
    expect(page.get_by_label("Token")).to_be_focused()
    expect(page.locator("#jobs")).to_be_hidden()
    sign_in(page, "dentine_0123456789ab_a-guess")
    expect(page.get_by_role("alert")).to_have_text(
        "This token is unknown, expired or revoked; ask an administrator for a new one."
    )
    looked_at(page, "sign-in")

    sign_in(page, f" {server.tokens[Scope.SUBMIT]} ")
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    expect(page.locator("#account")).to_contain_text("of-submit")
    looked_at(page, "signed-in")
    assert page.evaluate("[document.cookie, localStorage.length, sessionStorage.length]") == ["", 0, 0]
    (cookie,) = page.context.cookies()
    assert (cookie["name"], cookie["httpOnly"], cookie["sameSite"]) == (COOKIE, True, "Strict")

    page.reload()
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Token")).to_be_visible()
    assert page.context.cookies() == []


def test_a_reader_is_shown_nothing_that_he_may_not_press(page: Page, server: Guarded) -> None:
    failed = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/", "seed": FAILING_SEED}).json()["id"]
    page.goto("/")
    sign_in(page, server.tokens[Scope.READ])
    page.goto(f"/#/{failed}")
    expect(page.locator(".job .badge")).to_have_text("failed")
    expect(page.get_by_role("link", name="Download all (zip)")).to_be_visible()
    for name in ("Retry", "Cancel", "Name…", "Delete…"):
        expect(page.get_by_role("button", name=name)).to_have_count(0)
    for name in ("New job", "Dome"):
        expect(page.get_by_role("link", name=name)).to_have_count(0)
    looked_at(page, "reader")
    for address, lacking in (
        ("#/new", "submit"),
        ("#/rig", "submit"),
        ("#/submit", "submit"),
        ("#/dome", "operate-dome"),
    ):
        page.goto(f"/{address}")
        expect(page.get_by_role("alert")).to_contain_text(f"the scope {lacking}.")
        expect(page.locator("main button, main input")).to_have_count(0)
    page.goto(f"/#/{failed}")
    expect(page.locator(".job .badge")).to_have_text("failed")
    page.get_by_role("button", name="Sign out").click()
    sign_in(page, server.tokens[Scope.SUBMIT])
    expect(page.get_by_role("button", name="Retry")).to_be_visible()


def test_a_job_that_is_opened_before_the_list_has_come_shows_a_reader_no_buttons(page: Page, server: Guarded) -> None:
    failed = server.ask("POST", "/v1/jobs", Scope.SUBMIT, json={"capture": "/", "seed": FAILING_SEED}).json()["id"]
    page.goto("/")
    expect(page.get_by_label("Token")).to_be_focused()
    held = list[Route]()

    def hold(route: Route) -> None:
        held.append(route)

    page.route(re.compile(r"/v1/jobs(\?|$)"), hold)
    sign_in(page, server.tokens[Scope.READ])
    expect(page.get_by_label("Token")).to_have_count(0)
    page.goto(f"/#/{failed}")
    expect(page.locator(".job .badge")).to_have_text("failed")
    assert held
    expect(page.get_by_role("button", name="Retry")).to_have_count(0)
    page.unroute_all(behavior="ignoreErrors")


def test_a_revoked_token_brings_the_form_back(page: Page, server: Guarded) -> None:
    page.goto("/")
    sign_in(page, server.tokens[Scope.READ])
    expect(page.locator(".job .badge")).to_have_text("succeeded")
    server.ask("DELETE", f"/v1/tokens/{server.tokens[Scope.READ].split('_')[1]}", Scope.ADMIN)
    expect(page.get_by_label("Token")).to_be_visible()
    expect(page.locator(".job")).to_have_count(0)
    expect(page.locator("#jobs")).to_be_hidden()
