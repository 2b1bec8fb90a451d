"""Landmarks clicked in the page of ``dentine landmarks`` have the right coordinates in the scan and in photographs."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page

from services.calibrate.clicking.page import write_clicking_page
from services.core.errors import CaptureInputError
from services.core.files.scans import read_scan_file
from services.core.raw.folder import read_raw_folder
from tests.support.command_line import dentine
from tests.support.raw_folders import write_toml
from tests.support.raw_mouth import RawMouth, write_raw_mouth

pytestmark = pytest.mark.browser


@pytest.fixture
def mouth(tmp_path: Path) -> RawMouth:
    return write_raw_mouth(tmp_path)


def on_the_scan(page: Page, root: Path, xyz_mm: list[float]) -> tuple[float, float]:
    """Position in the page of a point of the scan in the first view. The rows of ``turn`` point right, up and to the
    viewer.
    """
    mesh = read_scan_file(root / "scan.ply").mesh
    places = mesh.vertices_mm[np.unique(mesh.faces)]
    low, high = places.min(axis=0), places.max(axis=0)
    turn = np.array(json.loads(page.locator("#content").text_content() or "")["scan"]["turn"])
    box = page.locator("#scan").bounding_box()
    assert box is not None
    px_per_mm = min(box["width"], box["height"]) / (1.05 * float(np.linalg.norm(high - low)))
    right, up, _ = turn @ (np.array(xyz_mm) - (low + high) / 2)
    return box["x"] + box["width"] / 2 + px_per_mm * right, box["y"] + box["height"] / 2 - px_per_mm * up


def on_the_photograph(page: Page, camera: int, xy_px: list[float], size: tuple[int, int]) -> tuple[float, float]:
    box = page.locator("canvas.photograph").nth(camera).bounding_box()
    assert box is not None
    scale = min(box["width"] / size[0], box["height"] / size[1])
    x, y = (box[side] / 2 + scale * (xy_px[k] - size[k] / 2) for k, side in enumerate(("width", "height")))
    return box["x"] + x, box["y"] + y


@pytest.mark.dear("It is the first to ask for the mouth's photographs.")
def test_what_is_clicked_is_saved_as_landmarks(chromium: Browser, mouth: RawMouth, tmp_path: Path) -> None:
    known = mouth.tree["landmark"]
    write_toml(mouth.root, mouth.tree | {"landmark": known[:1]})
    written = write_clicking_page(mouth.root, tmp_path / "page.html")
    folder = read_raw_folder(mouth.root)
    # The window is high enough for all views at once, because scrolling would move them under the mouse.
    page = chromium.new_page(viewport={"width": 1400, "height": 2600})
    trouble: list[str] = []
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.goto(written.as_uri())
    assert page.locator("#rows tr").count() == 1

    for landmark in known[1:]:
        page.fill("#tooth", str(landmark["tooth"]))
        page.fill("#point", landmark["point"])
        page.click("text=Begin this landmark")
        page.mouse.click(*on_the_scan(page, mouth.root, landmark["xyz_mm"]))
        for seen in landmark["pixels"]:
            camera = next(k for k, one in enumerate(folder.camera) if one.name == seen["camera"])
            page.mouse.click(*on_the_photograph(page, camera, seen["xy_px"], folder.camera[camera].size))
    with page.expect_download() as download:
        page.click("text=Save landmarks.toml")
    saved = tomllib.loads(Path(download.value.path()).read_text())["landmark"]
    assert trouble == []

    # A click is assumed to be accurate to 0.3 mm. A pixel of the page is 0.1 mm of the scan and less than one pixel of
    # a photograph.
    assert [(one["tooth"], one["point"]) for one in saved] == [(one["tooth"], one["point"]) for one in known]
    for one, true in zip(saved, known, strict=True):
        assert np.linalg.norm(np.subtract(one["xyz_mm"], true["xyz_mm"])) < 0.3
        assert [seen["camera"] for seen in one["pixels"]] == [seen["camera"] for seen in true["pixels"]]
        for seen, there in zip(one["pixels"], true["pixels"], strict=True):
            assert np.abs(np.subtract(seen["xy_px"], there["xy_px"])).max() < 1.0

    (mouth.root / "raw.toml").unlink()
    write_toml(mouth.root, mouth.tree | {"landmark": saved})
    assert len(read_raw_folder(mouth.root).landmark) == len(known)


def test_a_drag_turns_the_scan_and_clicks_nothing(chromium: Browser, mouth: RawMouth) -> None:
    written = write_clicking_page(mouth.root)
    page = chromium.new_page()
    page.goto(written.as_uri())
    before = page.locator("#toml").text_content()
    box = page.locator("#scan").bounding_box()
    assert box is not None
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    turned = "document.querySelector('#scan').toDataURL()"
    seen = page.evaluate(turned)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0], middle[1] + 80, steps=4)
    page.mouse.up()
    assert page.evaluate(turned) != seen
    assert page.locator("#toml").text_content() == before


def test_a_folder_without_a_scan_is_refused(mouth: RawMouth) -> None:
    write_toml(mouth.root, {key: value for key, value in mouth.tree.items() if key not in {"scan", "landmark"}})
    with pytest.raises(CaptureInputError, match=r"names no scan; add \[scan\]"):
        write_clicking_page(mouth.root)


def test_the_command_says_what_to_open(mouth: RawMouth) -> None:
    answer = dentine("landmarks", str(mouth.root))
    assert answer.returncode == 0, answer.stderr
    assert f"open {mouth.root / 'landmarks.html'} in a browser" in answer.stdout
