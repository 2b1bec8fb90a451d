"""The page of a job of kind slab shows its wavelengths, coefficients with ± and the report's phase functions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from services.api.app import create_app
from services.core.records import JobSpec
from services.core.results import FitReport
from services.core.settings import ServerSettings
from services.core.stage import StageEvent
from services.core.verdict import VERDICT, verdict_of
from services.pipeline.event_log import EventAddress
from services.slab.cell.dictionary import ANGLES_RAD, hg_values
from services.slab.results.chart import phase_picture
from services.slab.results.result import PhaseFunction
from tests.browser.pages import LOOKS, looked_at, watched_page
from tests.browser.scripted_job import expect_state
from tests.support.live_server import serving
from tests.support.small_slab import description, write_folder
from tests.support.uploading import write_capture

pytestmark = pytest.mark.browser

WAVELENGTHS_NM = (532, 635)


def verdict() -> dict[str, Any]:
    """Data of the event with which a fit of images without held-out ones finishes."""
    errors = {"532": 0.0031, "635": 0.0035}
    told: dict[str, Any] = {"fit_error": errors, "held_out_error": {}, "steps": 9, "seconds": 1.0}
    report = FitReport(converged=True, advice="", parameters={}, **told)
    return {VERDICT: verdict_of(report).model_dump(mode="json")}


def slab_job(_spec: JobSpec, folder: Path, events: EventAddress) -> None:
    """Write the events and files of a fit of two wavelengths."""
    with events.open() as log:
        fit = log.begin_stage("fit")
        for number, nm in enumerate(WAVELENGTHS_NM, start=1):
            data = {"wavelength_nm": float(nm), "wavelengths": len(WAVELENGTHS_NM)}
            message = f"{nm} nm: σs 1.204 ± 0.008 per mm; error on fitted images 0.31 %."
            log.append(fit, StageEvent(stage="fit", kind="progress", done=number / 2, message=message, data=data))
        log.append(fit, StageEvent(stage="fit", kind="finished", done=1.0, message="Converged.", data=verdict()))
        export = log.begin_stage("export")
        sigma = '"sigma_s": {"value": 1.204, "se": 0.008, "unit": "1/mm", "determined": true}'
        row = f'{{{sigma}, "g": {{"value": 0.61, "se": 0.2, "unit": "1", "determined": false}}}}'
        (folder / "parameters.json").write_text("{" + ", ".join(f'"{nm}": {row}' for nm in WAVELENGTHS_NM) + "}")
        p = hg_values(0.6)
        told = tuple(bool(angle > 0.12) for angle in ANGLES_RAD)
        phase = PhaseFunction(
            theta_deg=tuple(np.degrees(ANGLES_RAD)), value_per_sr=tuple(p), se_per_sr=tuple(0.05 * p), determined=told
        )
        for nm in WAVELENGTHS_NM:
            (folder / f"phase_{nm}.svg").write_text(phase_picture(f"Phase function at {nm} nm", phase))
        log.append(export, StageEvent(stage="export", kind="finished", done=1.0))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, str]]:
    """Client of a server, and the id of its slab job."""
    captures = tmp_path_factory.mktemp("captures")
    settings = ServerSettings(data=tmp_path_factory.mktemp("data"))
    write_folder(captures / "cell", description())
    with serving(create_app(settings, slab_job)) as client:
        answer = client.post("/v1/jobs", json={"kind": "slab", "capture": str(captures / "cell")})
        assert answer.status_code == 201, answer.text
        yield client, answer.json()["id"]


def test_the_page_shows_wavelengths_coefficients_and_phase_functions(
    chromium: Browser, server: tuple[httpx.Client, str]
) -> None:
    client, job = server
    with watched_page(chromium, str(client.base_url).rstrip("/"), *LOOKS[1]) as page:
        page.goto(f"/#/{job}")
        expect_state(page, job, "SUCCEEDED")
        expect(page.locator(".wavelengths li")).to_have_text(
            [f"{nm} nm: σs 1.204 ± 0.008 per mm; error on fitted images 0.31 %." for nm in WAVELENGTHS_NM]
        )
        expect(page.locator("thead th")).to_have_text(["parameter", "unit", "532 nm", "635 nm"])
        expect(page.locator("tbody th")).to_have_text(["scattering σs", "mean cosine g"])
        expect(page.locator("table caption")).to_have_text("Result: value ± one standard error.")
        expect(page.locator(".verdict")).to_contain_text("532 nm 0.31 %, 635 nm 0.35 %")
        expect(page.locator("td.number").first).to_have_text("1.2040 ± 0.0080")
        expect(page.locator(".phases img")).to_have_count(2)
        picture = page.get_by_alt_text("Phase function at 532 nm")
        picture.scroll_into_view_if_needed()
        page.wait_for_function(
            "[...document.querySelectorAll('.phases img')].every((image) => image.complete && image.naturalWidth ==="
            " 640)"
        )
        expect(page.locator(".job")).not_to_contain_text("No step yet")
        expect(page.locator(".job")).not_to_contain_text("No picture yet")
        looked_at(page, "slab")


def test_the_form_shows_the_options_of_the_chosen_kind(chromium: Browser, server: tuple[httpx.Client, str]) -> None:
    client, _ = server
    with watched_page(chromium, str(client.base_url).rstrip("/")) as page:
        page.goto("/#/submit")
        page.locator("summary", has_text="Accuracy and time").click()
        expect(page.locator("#option-max_steps")).to_be_visible()
        expect(page.locator("summary", has_text="Slab")).to_be_hidden()
        page.select_option("#option-kind", "slab")
        page.locator("summary", has_text="Slab").click()
        expect(page.locator("#option-effort")).to_be_visible()
        expect(page.locator("#option-max_steps")).to_be_hidden()
        expect(page.locator("#option-ior")).to_be_hidden()
        expect(page.locator("summary", has_text="Solver")).to_be_hidden()
        looked_at(page, "submit-slab")
        page.select_option("#preset", "standard")
        expect(page.locator("#option-max_steps")).to_be_visible()
        expect(page.locator("#option-effort")).to_be_hidden()


def test_a_slabs_capture_chooses_the_kind_of_its_job(
    chromium: Browser, server: tuple[httpx.Client, str], tmp_path: Path
) -> None:
    client, _ = server
    folders = write_capture(tmp_path / "tooth"), write_folder(tmp_path / "cell", description())
    with watched_page(chromium, str(client.base_url).rstrip("/")) as page:
        for folder, kind in zip(folders, ("tooth", "slab"), strict=True):
            page.goto("/#/new")
            page.set_input_files("#folder", str(folder))
            expect(page.get_by_role("heading", name="Submit a job")).to_be_visible()
            expect(page.locator("#option-kind")).to_have_value(kind)
        expect(page.locator("#option-ior")).to_be_hidden()
        page.select_option("#preset", "quick")
        expect(page.locator("#option-kind")).to_have_value("slab")
        of_tooth = client.get("/v1/captures").json()["captures"][1]["id"]
        page.select_option("#capture", of_tooth)
        expect(page.locator("#option-kind")).to_have_value("tooth")
        expect(page.locator("#option-ior")).to_be_visible()
