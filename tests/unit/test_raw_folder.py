"""``raw.toml``: what is read, and the sentence for what cannot be read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from services.core.errors import CaptureInputError
from services.core.raw.folder import read_raw_folder
from tests.support.raw_folders import Tree, write_raw_folder, write_toml

Change = Callable[[Tree], object]


def test_all_of_a_description_is_read(tmp_path: Path) -> None:
    write_raw_folder(tmp_path)
    folder = read_raw_folder(tmp_path)
    assert folder.channels == ("red", "green", "blue")
    assert [camera.full_counts for camera in folder.camera] == [4095.0, 4095.0]
    assert [frame.file for frame in folder.frames_of("right", "light")] == ["right_L1.npy", "right_L2.npy"]
    assert folder.frame[1].label == "camera left, light L1"
    assert [frame.target for frame in folder.frame[-4:]] == ["flat", "ball", "egg", "macbeth"]
    assert folder.landmark[0].pixels[0].xy_px == (3.5, 4.5)
    assert folder.scan is not None
    assert folder.frame[1].level == 0.5


BAD: dict[str, tuple[Change, str]] = {
    "unknown key at the top": (
        lambda t: t.update(colour="red"),
        r"raw\.toml: unknown key 'colour'; known keys are board",
    ),
    "unknown key of a camera": (
        lambda t: t["camera"][1].update(gamma=2.2),
        r"raw\.toml: camera 2 \(right\): unknown key 'gamma'; known keys are bits, channels",
    ),
    "unknown key of a frame": (
        lambda t: t["frame"][1].update(exposure=0.1),
        (
            r"frame 2 \(left_L1\.npy\): unknown key 'exposure'; known keys are board, camera, chart, corners_px,"
            r" exposure_s"
        ),
    ),
    "unknown key of a pixel": (
        lambda t: t["landmark"][0]["pixels"][0].update(z=1),
        r"landmark 1 \(11\) pixels 1: unknown key 'z'; known keys are camera, xy_px",
    ),
    "unknown key of the scan": (lambda t: t["scan"].update(scale=2), r"scan: unknown key 'scale'"),
    "missing exposure": (
        lambda t: t["frame"][1].pop("exposure_s"),
        r"frame 2 \(left_L1\.npy\): 'exposure_s' is missing; add it",
    ),
    "exposure of zero": (
        lambda t: t["frame"][1].update(exposure_s=0.0),
        r"frame 2 \(left_L1\.npy\): exposure_s: must be greater than 0; correct it",
    ),
    "exposure as a text": (
        lambda t: t["frame"][1].update(exposure_s="0.1"),
        r"exposure_s: give a number, neither a text nor true or false",
    ),
    "level above one": (lambda t: t["frame"][1].update(level=1.5), r"level: must be 1 or less; correct it"),
    "NaN": (lambda t: t["frame"][1].update(time_s=float("nan")), r"time_s: must be a finite number"),
    "pixel without y": (
        lambda t: t["frame"][-1]["corners_px"][2].pop(),
        r"frame 10 \(chart\.npy\): corners_px\[2\]\[1\]: ",
    ),
    "unknown kind": (
        lambda t: t["frame"][1].update(kind="lit"),
        r"frame 2 \(left_L1\.npy\): kind: must be 'black'",
    ),
    "no frame": (lambda t: t.update(frame=[]), r"'frame' is missing|frame: has 0 entries and needs at least 1"),
    "units in cm": (lambda t: t.update(units="cm"), r"units: must be 'mm'"),
    "a camera twice": (lambda t: t["camera"].append(t["camera"][0]), r"camera left is listed twice"),
    "a light twice": (lambda t: t["light"].append(t["light"][0]), r"light L1 is listed twice"),
    "a file twice": (lambda t: t["frame"].append(t["frame"][1]), r"file left_L1\.npy is listed in two frames"),
    "unknown camera": (
        lambda t: t["frame"][1].update(camera="rear"),
        r"frame left_L1\.npy names camera rear, which is not listed; listed are left, right",
    ),
    "unknown light": (
        lambda t: t["frame"][1].update(light="sun"),
        r"frame left_L1\.npy names light sun, which is not listed; listed are L1, L2",
    ),
    "unknown board": (lambda t: t["frame"][-4].update(board="b2"), r"frame board\.npy names board b2"),
    "sphere of the other kind": (
        lambda t: t["frame"][-3].update(sphere="egg"),
        r"frame mirror\.npy is of kind mirror-sphere, but sphere egg is white",
    ),
    "light frame without its light": (
        lambda t: t["frame"][1].pop("light"),
        r"frame 2 \(left_L1\.npy\): a frame of kind light must name its light",
    ),
    "black frame under a light": (
        lambda t: t["frame"][0].update(light="L1"),
        r"frame 1 \(left_black\.npy\): a frame of kind black has no light on; leave light out",
    ),
    "chart without its name": (lambda t: t["frame"][-1].pop("chart"), r"a frame of kind chart must name its chart"),
    "a sphere in a light frame": (
        lambda t: t["frame"][1].update(sphere="egg"),
        r"a frame of kind light has no sphere; leave it out",
    ),
    "charuco without its dictionary": (
        lambda t: t["board"][0].pop("dictionary"),
        r"board 1 \(flat\): a board of type charuco needs dictionary",
    ),
    "marker as large as its square": (
        lambda t: t["board"][0].update(marker_mm=12.0),
        r"marker_mm = 12 must be smaller than square_mm = 12",
    ),
    "white sphere without reflectance": (
        lambda t: t["sphere"][1].pop("reflectance"),
        r"sphere 2 \(egg\): a white sphere needs its reflectance",
    ),
    "reflectances of other channels": (
        lambda t: t["sphere"][1].update(reflectance=[0.9]),
        r"sphere egg has 1 reflectances for 3 channels",
    ),
    "bits beyond the file": (
        lambda t: t["camera"][0].update(shift=8),
        r"bits = 12 and shift = 8 go beyond the 16 bits",
    ),
    "saturation beyond the bits": (
        lambda t: t["camera"][0].update(saturation_counts=5000),
        r"saturation_counts = 5000 is more than 12 bits hold \(4095\)",
    ),
    "a mosaic with channels": (
        lambda t: t["camera"][0].update(mosaic="RGGB", channels=["green", "red", "blue"]),
        r"a mosaic has the channels red, green, blue",
    ),
    "unknown mosaic": (
        lambda t: t["camera"][0].update(mosaic="RGBG"),
        r"camera 1 \(left\): mosaic: must be 'none'",
    ),
    "cameras of other channels": (
        lambda t: t["camera"][1].update(channels=["green"]),
        r"camera right has channels green, but left has red, green, blue",
    ),
    "no tooth's number": (
        lambda t: t["landmark"][0].update(tooth=9),
        r"landmark 1 \(9\): tooth: must be 11 or more",
    ),
    "a landmark twice": (
        lambda t: t["landmark"].append(t["landmark"][0]),
        r"landmark 11 mesial edge is listed twice",
    ),
    "a file elsewhere": (
        lambda t: t["frame"][1].update(file="../x.npy"),
        r"Frame \.\./x\.npy .* lies outside the folder",
    ),
    "a file that is not there": (
        lambda t: t["frame"][1].update(file="gone.npy"),
        r"Frame gone\.npy \(camera left, light L1\) does not exist in .*; put it there or remove its entry",
    ),
    "a calibration that is not there": (
        lambda t: t.update(calibration={"file": "calibration.json"}),
        r"Calibration .*calibration\.json does not exist",
    ),
    "NUL in a path": (
        lambda t: t["chart"][0].update(reference="a\\u0000.csv"),
        r"reference: no path holds the character NUL",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_what_is_wrong_is_said_in_one_sentence(case: str, tmp_path: Path) -> None:
    change, pattern = BAD[case]
    tree = write_raw_folder(tmp_path)
    change(tree)
    write_toml(tmp_path, tree)
    text = (tmp_path / "raw.toml").read_text().replace("\\\\u0000", "\\u0000")
    (tmp_path / "raw.toml").write_text(text)
    with pytest.raises(CaptureInputError, match=pattern) as caught:
        read_raw_folder(tmp_path)
    assert caught.value.message.endswith(".")
    assert "\n" not in caught.value.message


@pytest.mark.parametrize(
    ("content", "pattern"),
    [
        (b"units = ", r"raw\.toml is not valid TOML"),
        (b"\xff\xfe", r"raw\.toml is not valid TOML"),
        (b"x = " + b"[" * 100_000, r"raw\.toml (nests brackets too deeply|is not valid TOML)"),
        (b"", r"raw\.toml: 'units' is missing; add it\."),
        (b'units = "mm"\n[frame]\n', r"raw\.toml: "),
    ],
)
def test_what_is_no_description(content: bytes, pattern: str, tmp_path: Path) -> None:
    (tmp_path / "raw.toml").write_bytes(content)
    with pytest.raises(CaptureInputError, match=pattern):
        read_raw_folder(tmp_path)


def test_a_folder_without_a_description_says_what_makes_one(tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match=r"raw\.toml does not exist; 'dentine import"):
        read_raw_folder(tmp_path)
