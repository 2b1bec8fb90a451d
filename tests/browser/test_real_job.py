"""serve -> submit -> live loss curve -> report with the real stages on a tooth of few pixels: nothing between the page
and the rendering kernel is replaced by a stand-in.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from services.api.app import STATIC

pytestmark = [pytest.mark.browser, pytest.mark.slow, pytest.mark.timeout(900)]

DENTINE = [sys.executable, "-m", "services"]
MINUTES_MS = 60_000
JOB = """
boundary = "matched"
dentin = "known"
samples_per_pixel = 16
max_samples_per_pixel = 16
max_steps = 1
search_candidates = 100
pixel_step = 2
[rig]
mouth = "mouth"
"""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[str]:
    command = [*DENTINE, "serve", "--port", "0", "--data", str(tmp_path / "data")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process.stdout.readline().strip()
        process.terminate()
        assert process.wait(60) == 0


def test_a_tooth_is_measured_before_the_visitors_eyes(chromium: Browser, server: str, tmp_path: Path) -> None:
    if not (STATIC / "app.js").exists():
        pytest.skip("the dashboard is not built; run make dashboard")
    size = ["--pixel-mm", "1", "--cameras", "2", "--lights", "4", "--samples", "64"]
    subprocess.run([*DENTINE, "phantom", "--out", str(tmp_path / "mouth"), *size], check=True)
    (tmp_path / "job.toml").write_text(JOB)
    page = chromium.new_context(base_url=server).new_page()
    page.goto("/")
    expect(page.get_by_text("No job yet")).to_be_visible()
    subprocess.run([*DENTINE, "submit", str(tmp_path / "job.toml"), "--server", server], check=True)

    page.locator("#jobs a").first.click()
    expect(page.locator(".stages li", has_text="capture").locator(".state")).to_have_text(
        "finished", timeout=2 * MINUTES_MS
    )
    expect(page.locator(".chart canvas")).to_be_visible(timeout=8 * MINUTES_MS)
    expect(page.locator(".job .badge")).to_have_text("running")
    expect(page.locator(".job .badge")).to_have_text("not converged", timeout=8 * MINUTES_MS)  # with one step
    expect(page.locator("tr", has_text="enamel.sigma_s_reduced")).to_contain_text("mm⁻¹")
    with page.expect_popup() as popup:
        page.get_by_role("link", name="Open the report").click()
    expect(popup.value.locator("body")).to_contain_text("Tooth 11")
    assert popup.value.locator("img").first.evaluate("image => image.complete && image.naturalWidth > 0")
    popup.value.context.close()
