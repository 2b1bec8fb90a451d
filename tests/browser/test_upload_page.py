"""Upload of a folder in the page: by choice and by drop, over broken connections, and resumed after a reload."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Browser, Page, Request, Route, expect

from services.api.app import create_app
from services.core.settings import ServerSettings
from tests.browser.pages import looked_at, watched_page
from tests.support.guarded_server import run_nothing
from tests.support.live_server import serving
from tests.support.uploading import contents_of, write_capture

pytestmark = pytest.mark.browser

BLOCK_BYTES = 4 * 2**20
LARGE = "large.npy"
BROKEN = ("Failed to load resource",)
"""Console message of the browser for a connection that the test breaks."""


@pytest.fixture
def server(tmp_path: Path) -> Iterator[httpx.Client]:
    with serving(create_app(ServerSettings(data=tmp_path / "data"), run_nothing)) as client:
        yield client


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A capture with a file that is sent in three blocks."""
    folder = write_capture(tmp_path / "mine")
    np.save(folder / LARGE, np.random.default_rng(0).random((2 * BLOCK_BYTES + 2**16) // 4, dtype=np.float32))
    return folder


def choose(page: Page, folder: Path) -> None:
    page.set_input_files("#folder", str(folder))


def expect_uploaded(page: Page, server: httpx.Client, data: Path, contents: dict[str, bytes]) -> None:
    """Assert that the page shows the form with this capture chosen, and that the server stores the sent contents."""
    expect(page.get_by_role("heading", name="Submit a job")).to_be_visible()
    (capture,) = server.get("/v1/captures").json()["captures"]
    assert capture["state"] == "committed"
    expect(page.get_by_label("Capture", exact=True)).to_have_value(capture["id"])
    assert contents_of(data / "captures" / capture["id"]) == contents


@pytest.mark.dear("The browser hands each block of 4 MiB to the test.")
def test_a_folder_is_uploaded_and_its_job_submitted(
    chromium: Browser, server: httpx.Client, folder: Path, tmp_path: Path
) -> None:
    contents = contents_of(folder)
    (folder / "notes.txt").write_text("mine")
    (folder / ".hidden.json").write_text("{}")
    with watched_page(chromium, str(server.base_url).rstrip("/")) as page:
        page.goto("/")
        page.route("**/v1/uploads/**", lambda _route: None)
        choose(page, folder)
        expect(page.locator(".upload [role=status]")).to_contain_text("Sending")
        expect(page.locator(".upload progress")).to_be_visible()
        expect(page.locator(".upload")).to_contain_text("Left out, as no part of a capture: ")
        expect(page.locator(".upload")).to_contain_text("notes.txt")
        looked_at(page, "upload")
        page.unroute("**/v1/uploads/**")  # the upload goes on
        expect_uploaded(page, server, tmp_path / "data", contents)
        page.get_by_role("button", name="Submit the job").click()
        expect(page.locator(".job .badge")).to_have_text("succeeded")


@pytest.mark.dear("The browser hands each block of 4 MiB to the test, which breaks the second one twice.")
def test_a_broken_connection_is_gone_on_with(
    chromium: Browser, server: httpx.Client, folder: Path, tmp_path: Path
) -> None:
    with watched_page(chromium, str(server.base_url).rstrip("/"), expected=BROKEN) as page:
        page.goto("/")
        sent: list[str] = []

        def break_the_second_block(route: Route, request: Request) -> None:
            if request.method == "PATCH" and request.headers["upload-offset"] == str(BLOCK_BYTES):
                sent.append("broken")
                if len(sent) < 3:
                    route.abort("connectionreset")
                    return
            route.fallback()

        page.route("**/v1/uploads/**", break_the_second_block)
        choose(page, folder)
        expect_uploaded(page, server, tmp_path / "data", contents_of(folder))
        assert sent == ["broken"] * 3


@pytest.mark.dear("The browser hands each block of 4 MiB to the test, before a reload and after it.")
def test_the_same_folder_goes_on_after_a_reload(
    chromium: Browser, server: httpx.Client, folder: Path, tmp_path: Path
) -> None:
    with watched_page(chromium, str(server.base_url).rstrip("/"), expected=BROKEN) as page:
        page.on("dialog", lambda dialog: dialog.accept())
        page.goto("/")
        page.route(
            "**/v1/uploads/**",
            lambda route: (
                route.abort() if route.request.headers.get("upload-offset") == str(BLOCK_BYTES) else route.fallback()
            ),
        )
        choose(page, folder)
        expect(page.locator(".upload [role=status]")).to_contain_text(f"Sending {LARGE}")
        page.wait_for_event("requestfailed", lambda request: request.method == "PATCH")
        page.unroute("**/v1/uploads/**")
        page.reload()
        expect(page.locator(".upload progress")).to_be_hidden()
        offsets: list[int] = []
        page.on(
            "request",
            lambda request: (
                offsets.append(int(request.headers["upload-offset"])) if request.method == "PATCH" else None
            ),
        )
        choose(page, folder)
        expect_uploaded(page, server, tmp_path / "data", contents_of(folder))
    assert offsets == [
        BLOCK_BYTES,
        2 * BLOCK_BYTES,
        0,
    ]  # the rest of the large file and the one after it; nothing was sent twice


@pytest.mark.dear("The browser hands each block of 4 MiB to the test.")
def test_a_dropped_folder_is_uploaded(chromium: Browser, server: httpx.Client, folder: Path, tmp_path: Path) -> None:
    with watched_page(chromium, str(server.base_url).rstrip("/")) as page:
        page.goto("/")
        box = page.locator(".drop").bounding_box()
        assert box is not None
        where = {
            "x": box["x"] + 20,
            "y": box["y"] + 20,
            "data": {"items": [], "files": [str(folder)], "dragOperationsMask": 1},
        }
        devtools = page.context.new_cdp_session(page)
        for kind in ("dragEnter", "dragOver", "drop"):
            devtools.send("Input.dispatchDragEvent", {"type": kind} | where)
        expect_uploaded(page, server, tmp_path / "data", contents_of(folder))


def test_a_folder_that_is_no_capture_is_refused_in_a_sentence(
    chromium: Browser, server: httpx.Client, tmp_path: Path
) -> None:
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("x")
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "outer.ply").write_text("ply\n")
    with watched_page(chromium, str(server.base_url).rstrip("/"), expected=("422",)) as page:
        page.goto("/")
        choose(page, tmp_path / "other")
        expect(page.get_by_role("alert")).to_contain_text(
            "The folder holds no file of a capture; choose the one with capture.json, raw.toml or slab.json."
        )
        choose(page, tmp_path / "meshes")
        expect(page.get_by_role("alert")).to_contain_text("The capture holds neither capture.json nor manifest.json")
