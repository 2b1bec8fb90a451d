"""The way from the setup link in the log to the demonstration's report, in a real browser on a new system, and the size
of the system's images and memory.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, expect

from tests.browser.chromium import chromium  # noqa: F401 - a fixture
from tests.browser.pages import looked_at, watched_page
from tests.containers.composed_system import USER, ComposedSystem
from tests.support.store_disk import StoreDisk

MEGA = 1e6
DEMO_MS = 1_800_000
"""Time limit of the demonstration, which renders a tooth and fits it: minutes on two idle cores, more on busy ones."""


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[ComposedSystem]:
    """A second system without any data."""
    disk = StoreDisk(tmp_path / "data", 4 * 2**30)
    disk.open()
    os.chown(disk.folder, USER, USER)
    system = ComposedSystem("dentinefresh", disk.folder)
    try:
        system.compose("up", "--detach")
        system.wait_until(system.is_live, "the API does not answer")
        yield system
    finally:
        system.down("--volumes", "--timeout", "20")
        disk.close()


def test_three_clicks_lead_from_the_link_to_the_report(fresh: ComposedSystem, chromium: Browser) -> None:  # noqa: F811
    log = fresh.compose("logs", "api")
    (link,) = re.findall(r"http://[\w.:]+(/#/setup/[\w-]+)", log)
    clicks = 0
    with watched_page(chromium, fresh.address, expected=("401",)) as page:
        page.goto(link)
        page.get_by_role("button", name="Make the administrator's token").click()
        clicks += 1
        page.get_by_role("button", name="Run the demo").click()
        clicks += 1
        expect(page.locator(".job .badge")).to_have_text("succeeded", timeout=DEMO_MS)
        looked_at(page, "composed-demo")
        with page.context.expect_page() as opened:
            page.get_by_role("link", name="Open the report").click()
        clicks += 1
        expect(opened.value.locator("body")).to_contain_text("held-out")
        if folder := os.environ.get("SCREENSHOTS"):
            opened.value.screenshot(path=f"{folder}/composed-report.png", full_page=True)
    assert clicks == 3


def test_what_the_system_weighs_is_measured(system: ComposedSystem, figures: dict[str, Any]) -> None:
    images = {
        role: system.inspect(system.inspect(system.container(role))["Image"])["Size"] / MEGA
        for role in ("api", "worker")
    }
    figures["image_mb"] = {role: round(size) for role, size in images.items()}
    told = system.engine("stats", "--no-stream", "--format", "{{.Name}} {{.MemUsage}}")
    figures["memory_at_rest"] = {
        line.split()[0]: line.split()[1] for line in told.splitlines() if line.startswith(system.project)
    }
    assert len(figures["memory_at_rest"]) == 6
    assert images["api"] < images["worker"] < 1500
