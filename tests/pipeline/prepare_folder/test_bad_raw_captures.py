"""Raw folders that cannot be prepared end in one sentence that names the frame and the remedy."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from services.core.errors import CaptureInputError
from tests.support.folder_captures import prepare
from tests.support.mouth import write_mouth
from tests.support.raw_captures import write_raw_capture
from tests.support.raw_folders import Tree, write_toml
from tests.support.raw_sensor import Sensor

FRAME = "c0_l2_0.1.npy"
"""File of the last light's longer exposure, which every kind of bad input below damages or contradicts."""
Damage = Callable[[Path, Tree], object]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Tree]:
    """A raw folder that preparation accepts: one camera, four lights, two exposures, with stronger red."""
    root = tmp_path_factory.mktemp("whole")
    write_mouth(root / "mouth", lights=4, sizes=((40, 32),))
    tree = json.loads((root / "mouth" / "capture.json").read_text())
    tree["cameras"][0]["K"][0][0] = tree["cameras"][0]["K"][1][1] = 300.0
    (root / "mouth" / "capture.json").write_text(json.dumps(tree))
    for file in (root / "mouth").glob("*.npy"):
        y, x = np.mgrid[:32, :40]
        texture = 1 + 0.6 * np.sin(0.8 * x) * np.cos(0.7 * y)
        np.save(file, (np.load(file) * texture[..., None] * np.array([1.6, 1.2, 0.7])).astype(np.float32))
    return root / "raw", write_raw_capture(root / "raw", root / "mouth", Sensor(), (0.025, 0.1), blacks=2)


def entry(tree: Tree, file: str = FRAME) -> dict[str, Any]:
    found: dict[str, Any] = next(one for one in tree["frame"] if one["file"] == file)
    return found


def told(**changed: Any) -> Damage:
    """Damage that changes the frame's entry in the description."""
    return lambda _, tree: entry(tree).update(changed)


def values(make: Callable[[np.ndarray], np.ndarray], file: str = FRAME) -> Damage:
    """Damage that changes the counts of a frame."""
    return lambda root, _: np.save(root / file, make(np.load(root / file)))


def replaced(name: str, content: bytes) -> Damage:
    """Damage that replaces the frame by another file."""

    def damage(root: Path, tree: Tree) -> None:
        (root / name).write_bytes(content)
        entry(tree)["file"] = name

    return damage


def image(name: str, make: Callable[[np.ndarray], np.ndarray] = lambda v: v, share: float = 1.0) -> Damage:
    """Damage that stores the frame as a file written by OpenCV, cut off after a share of its bytes."""

    def damage(root: Path, tree: Tree) -> None:
        cv2.imwrite(str(root / name), make(np.load(root / FRAME))[..., ::-1])
        content = (root / name).read_bytes()
        replaced(name, content[: int(share * len(content))])(root, tree)

    return damage


def calibrated(change: Callable[[Tree], object]) -> Damage:
    def damage(root: Path, _: Tree) -> None:
        calibration = json.loads((root / "calibration.json").read_text())
        change(calibration)
        (root / "calibration.json").write_text(json.dumps(calibration))

    return damage


def without(kind: str) -> Damage:
    def damage(_: Path, tree: Tree) -> None:
        tree["frame"][:] = [one for one in tree["frame"] if one["kind"] != kind]

    return damage


def shifted_mosaic(root: Path, tree: Tree) -> None:
    """Damage that stores all frames as a mosaic, with this frame's pattern shifted by one column."""
    tree["camera"][0]["mosaic"] = "RGGB"
    del tree["camera"][0]["channels"]
    for one in tree["frame"]:
        colours, mosaic = np.load(root / one["file"]), np.empty((32, 40), dtype=np.uint16)
        letters = "GRBG" if one["file"] == FRAME else "RGGB"
        for k, letter in enumerate(letters):
            mosaic[k // 2 :: 2, k % 2 :: 2] = colours[k // 2 :: 2, k % 2 :: 2, "RGB".index(letter)]
        np.save(root / one["file"], mosaic)


def exchanged(root: Path, _: Tree) -> None:
    for file in (FRAME, "c0_l2_0.025.npy"):
        np.save(root / file, np.load(root / file)[..., ::-1])


def jpeg() -> bytes:
    return bytes(cv2.imencode(".jpg", np.full((32, 40, 3), 90, dtype=np.uint8))[1])


HERE = r"c0_l2_0\.1\.npy \(camera c0, light l2\)"
BAD: dict[str, tuple[Damage, str]] = {
    "PNG cut off": (image("x.png", share=0.5), r"x\.png \(camera c0, light l2\) cannot be read .*truncated"),
    "TIFF cut off": (image("x.tif", share=0.5), r"x\.tif \(camera c0, light l2\) cannot be read .*truncated"),
    "NPY cut off": (lambda root, _: os_truncate(root / FRAME), rf"{HERE} cannot be read .*truncated"),
    "nothing in it": (replaced("x.png", b""), r"x\.png \(camera c0, light l2\) is empty; copy it again"),
    "JPEG for raw": (
        replaced("x.jpg", jpeg()),
        r"x\.jpg \(camera c0, light l2\) is a JPEG, whose values are no counts",
    ),
    "JPEG that calls itself raw": (replaced("x.dng", jpeg()), r"x\.dng \(camera c0, light l2\) is a JPEG"),
    "no camera's raw file": (
        replaced("x.nef", bytes(range(256)) * 9),
        r"x\.nef \(camera c0, light l2\) cannot be read",
    ),
    "a film": (replaced("x.mov", b"ftypqt  " * 9), r"x\.mov \(camera c0, light l2\) is of a format that is not read"),
    "8 bits for 12": (
        image("x.png", lambda v: (v >> 4).astype(np.uint8)),
        r"x\.png .* has 8 bits a count, but its camera has 12",
    ),
    "12 bits in the high ones": (
        values(lambda v: v << 4),
        rf"{HERE} holds a count of \d+, more than the 12 bits .*set shift",
    ),
    "whole numbers of 32 bits": (values(lambda v: v.astype(np.int32)), rf"{HERE} holds numbers of type int32"),
    "channels exchanged": (
        image("x.png", lambda v: v[..., ::-1]),
        (
            r"x\.png \(camera c0, light l2\) has red and blue exchanged against c0_l2_0\.025\.npy; export both with the"
            r" same order"
        ),
    ),
    "channels of both exposures exchanged": (
        exchanged,
        (
            r"Frame c0_l2_0\.025\.npy \(camera c0, light l2\) has 0\.\d+ times as much red as blue where"
            r" c0_l0_0\.025\.npy has \d"
        ),
    ),
    "another size": (values(lambda v: v[:, 1:]), rf"{HERE} has 39 x 32 pixels, but its camera has 40 x 32"),
    "turned": (values(lambda v: v.swapaxes(0, 1)), rf"{HERE} has 32 x 40 pixels \(turned by 90 degrees\?\)"),
    "grey for colour": (
        values(lambda v: v[..., 1]),
        rf"{HERE} has one number a pixel, but its camera is described with colours; give the camera channels",
    ),
    "NaN": (
        values(lambda v: np.where(v > 900, np.nan, v).astype(np.float32)),
        rf"{HERE} has \d+ values that are no finite",
    ),
    "wrong mosaic": (shifted_mosaic, rf"{HERE} has green pixels that differ by \d+%, so it does not begin RGGB"),
    "missing file": (lambda root, _: (root / FRAME).unlink(), rf"Frame {HERE} does not exist in .*; put it there"),
    "file elsewhere": (told(file="../x.npy"), r"Frame \.\./x\.npy \(camera c0, light l2\) lies outside the folder"),
    "missing black": (
        without("black"),
        r"Camera c0 has no black frame, so the zero of c0_flat0\.npy and its other frames",
    ),
    "black with the light on": (
        values(lambda v: v + np.uint16(1500), "c0_black1_0.1.npy"),
        r"c0_black1_0\.1\.npy \(camera c0, black\) has a median of \d+ counts, so it is no black frame",
    ),
    "exposure in the wrong unit": (
        told(exposure_s=100.0),
        rf"{HERE} is clearly darker than c0_l2_0\.025\.npy lets expect from exposure_s, gain and level",
    ),
    "bytes exchanged": (
        values(lambda v: v.byteswap() >> 4),
        rf"{HERE} shows another picture than c0_l2_0\.025\.npy; exchange its bytes",
    ),
    "unknown light": (
        told(light="l9"),
        r"frame c0_l2_0\.1\.npy names light l9, which is not listed; listed are l0, l1",
    ),
    "unknown camera": (told(camera="c9"), r"frame c0_l2_0\.1\.npy names camera c9, which is not listed; listed are c0"),
    "unknown key": (told(shutter=0.1), r"frame \d+ \(c0_l2_0\.1\.npy\): unknown key 'shutter'; known keys are"),
    "no exposure": (
        lambda _, tree: entry(tree).pop("exposure_s"),
        r"frame \d+ \(c0_l2_0\.1\.npy\): 'exposure_s' is missing",
    ),
    "no light": (
        lambda _, tree: entry(tree).pop("light"),
        r"frame \d+ \(c0_l2_0\.1\.npy\): a frame of kind light must name",
    ),
    "listed twice": (
        lambda _, tree: tree["frame"].append(entry(tree)),
        r"file c0_l2_0\.1\.npy is listed in two frames",
    ),
    "light not calibrated": (
        calibrated(lambda c: c["lights"].pop(2)),
        r"lacks light l2, under which frame c0_l2_0\.025\.npy was taken; choose that of this rig",
    ),
    "calibration of another camera": (calibrated(lambda c: c["cameras"][0].update(name="c7")), r"lacks camera c0 of"),
    "calibration of another size": (
        calibrated(lambda c: c["cameras"][0].update(size=[80, 64])),
        r"is for images of 80 x 64 pixels of camera c0, but .* has 40 x 32; calibrate anew",
    ),
    "counts without a scale": (
        calibrated(lambda c: c["cameras"][0].pop("radiance_per_count")),
        r"does not say radiance_per_count of camera c0",
    ),
    "no calibration": (
        lambda _, tree: tree.pop("calibration"),
        r"raw\.toml names no calibration.*option 'calibration'",
    ),
    "no lit frame": (without("light"), r"raw\.toml lists no frame of kind light; add the photographs of the teeth"),
}


def os_truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:400])


@pytest.mark.parametrize("case", BAD)
def test_bad_input_ends_in_one_sentence(case: str, whole: tuple[Path, Tree], tmp_path: Path) -> None:
    folder, job = tmp_path / "raw", tmp_path / "job"
    shutil.copytree(whole[0], folder)
    tree = json.loads(json.dumps(whole[1]))
    damage, pattern = BAD[case]
    damage(folder, tree)
    write_toml(folder, tree)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    with pytest.raises(CaptureInputError, match=pattern) as caught:
        prepare(folder, job)
    assert caught.value.message.endswith(".")
    assert "\n" not in caught.value.message
    assert not (job / "prepared").exists()
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_short_list_of_exposures_is_said(whole: tuple[Path, Tree], tmp_path: Path) -> None:
    shutil.copytree(whole[0], tmp_path / "raw")
    tree = json.loads(json.dumps(whole[1]))
    tree["frame"].remove(entry(tree))
    write_toml(tmp_path / "raw", tree)
    manifest = prepare(tmp_path / "raw", tmp_path / "job")
    sentence = "Camera c0, light l2 lacks the exposure of 0.1 s that most lights have; its frames are c0_l2_0.025.npy."
    assert sentence in manifest.notes
