"""A page whose errors fail the test: console messages, exceptions of scripts, and requests to other servers."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import pytest
from playwright.sync_api import Browser, Page

from services.api.app import STATIC
from tests.browser.chromium import PATIENCE_MS
from tests.browser.contrast import contrast_failures

WIDE, PHONE = (1440, 900), (390, 844)
LOOKS: tuple[tuple[Literal["light", "dark"], int], ...] = (("light", WIDE[0]), ("dark", PHONE[0]))
"""Colour scheme and width of the two looks in which what a page shows is tested: each scheme and each width once."""


@contextmanager
def watched_page(
    chromium: Browser, address: str, scheme: str = "light", width: int = WIDE[0], expected: tuple[str, ...] = ()
) -> Iterator[Page]:
    """Open a page on a server for the time of the block; afterwards, assert that it had no errors.

    Args:
        expected: texts of console messages that the test provokes, such as the browser's message on a refusal.
    """
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    context = chromium.new_context(base_url=address, color_scheme=scheme, viewport={"width": width, "height": 900})
    page = context.new_page()
    said: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: said.append(message.text) if message.type in {"error", "warning"} else None)
    page.on("pageerror", lambda problem: said.append(str(problem)))
    page.on("request", lambda request: asked.append(request.url))
    try:
        yield page
    finally:
        context.close()
    assert [line for line in said if not any(text in line for text in expected)] == []
    assert all(url.startswith((address, "blob:")) for url in asked)


def looked_at(page: Page, name: str) -> None:
    """Assert that what the page shows has enough contrast and is not too wide in both looks, and return to the page's
    own; store screenshots in the folder that the environment variable SCREENSHOTS names, if it is set.
    """
    own = page.viewport_size
    assert own is not None
    for scheme, width in LOOKS:
        page.emulate_media(color_scheme=scheme)
        page.set_viewport_size({"width": width, "height": own["height"]})
        if folder := os.environ.get("SCREENSHOTS"):
            page.screenshot(path=f"{folder}/{name}-{scheme}-{width}.png", full_page=True)
        assert contrast_failures(page) == [], (scheme, width)
        deadline_s = time.monotonic() + PATIENCE_MS / 1000
        while not page.evaluate("document.documentElement.scrollWidth <= innerWidth"):  # charts follow a new width late
            assert time.monotonic() < deadline_s, f"the page is wider than {width} px"
            page.wait_for_timeout(50)
    page.emulate_media(color_scheme="null")
    page.set_viewport_size(own)
