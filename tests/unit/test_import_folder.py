"""A folder of named photographs becomes a raw folder; what is missing is reported."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from services.capture.raw.importing import import_folder
from services.capture.raw.names import NamedFrame, named_frame
from services.cli.app import build_app
from services.core.errors import CaptureInputError
from services.core.raw.folder import read_raw_folder
from services.core.raw.frames import read_counts
from tests.support.raw_folders import counts


@pytest.mark.parametrize(
    ("file", "told"),
    [
        ("left_L07_0.05s.tif", ("left", "light", "L07", 0.05, 1.0)),
        ("left/L07/50ms.tif", ("left", "light", "L07", 0.05, 1.0)),
        ("left/black_50ms_2.png", ("left", "black", None, 0.05, 1.0)),
        ("right_tracking_003_1-20s.dng", ("right", "tracking", None, 0.05, 1.0)),
        ("c0_flat2_0.1s_gain4.npy", ("c0", "flat", None, 0.1, 4.0)),
        ("c0 mirror l3.npy", ("c0", "mirror-sphere", "l3", None, 1.0)),
        ("c0_dark-room_1s.exr", ("c0", "dark-room", None, 1.0, 1.0)),
    ],
)
def test_names(file: str, told: tuple[object, ...]) -> None:
    found = named_frame(file)
    assert isinstance(found, NamedFrame)
    assert (found.camera, found.kind, found.light, found.exposure_s, found.gain) == told


@pytest.mark.parametrize(
    ("file", "pattern"),
    [
        ("0.05s.tif", "does not name its camera"),
        ("c0_L0_0.02.npy", "says 0.02 without a unit, such as 0.02s"),
        ("left_0.05s.tif", "names camera left, and neither a light nor a kind"),
        ("left_white_0.05s.tif", "is of kind white-sphere and does not name its light"),
    ],
)
def test_names_that_lack_something(file: str, pattern: str) -> None:
    found = named_frame(file)
    assert isinstance(found, str)
    assert found.startswith(pattern)


@pytest.mark.parametrize(
    ("file", "place"),
    [
        ("c0_board3_5ms.npy", "board3"),
        ("c0_board_003_5ms.npy", "board003"),
        ("c0_mirror1_L2_5ms.npy", "mirror1"),
        ("c0_white_L2_1_5ms.npy", "white1"),
        ("c0_tracking_003_5ms.npy", None),
    ],
)
def test_where_a_board_or_sphere_lay(file: str, place: str | None) -> None:
    found = named_frame(file)
    assert isinstance(found, NamedFrame)
    assert found.place == place


@pytest.fixture
def photographs(tmp_path: Path) -> Path:
    """Two cameras of 12 bits: one writes colour in the high bits of 16, the other a mosaic in the low bits."""
    for camera, shift in (("left", 4), ("right", 0)):
        (tmp_path / camera).mkdir()
        for k, name in enumerate(("black_10ms", "L1_10ms", "L1_40ms", "L2_10ms", "L2_40ms", "all_10ms")):
            values = counts(k, 3 if camera == "left" else 1) | np.uint16(2049 if k else 1)
            cv2.imwrite(str(tmp_path / camera / f"{name}.png"), (values << shift)[..., ::-1])
    return tmp_path


def test_a_folder_is_described_and_read_again(photographs: Path) -> None:
    imported = import_folder(photographs, None, "GBRG", None)
    folder = read_raw_folder(photographs)
    assert folder == imported.folder
    left, right = (folder.camera_named(name) for name in ("left", "right"))
    assert (left.bits, left.shift, left.mosaic, left.size) == (12, 4, "none", (24, 16))
    assert (right.bits, right.shift, right.mosaic) == (12, 0, "GBRG")
    assert [light.name for light in folder.light] == ["L1", "L2"]
    lit = folder.frames_of("left", "light")
    assert [(one.light, one.exposure_s) for one in lit] == [("L1", 0.01), ("L1", 0.04), ("L2", 0.01), ("L2", 0.04)]
    np.testing.assert_array_equal(read_counts(photographs, folder, lit[0]), counts(1) | np.uint16(2049))
    said = "\n".join(imported.missing)
    for sentence in (
        "left has no flat frame",
        "fewer than 4 tracking frames",
        "No calibration is named",
        "There are no teeth",
    ):
        assert sentence in said
    assert "has no black frame" not in said
    with pytest.raises(CaptureInputError, match=r"raw\.toml exists; remove it"):
        import_folder(photographs, None, None, None)


def test_a_calibration_that_cannot_be_read_is_refused_before_anything_is_written(photographs: Path) -> None:
    with pytest.raises(CaptureInputError, match=r"calibration\.json does not exist; check the path\."):
        import_folder(photographs, None, "GBRG", photographs / "calibration.json")
    (photographs / "calibration.json").write_text("{}")
    with pytest.raises(CaptureInputError, match=r"calibration\.json: .units. is missing; add it\."):
        import_folder(photographs, None, "GBRG", photographs / "calibration.json")
    assert not (photographs / "raw.toml").exists()


def test_what_one_camera_lacks_is_said(photographs: Path) -> None:
    (photographs / "right" / "black_10ms.png").unlink()
    (photographs / "right" / "L2_10ms.png").unlink()
    (photographs / "right" / "L2_40ms.png").unlink()
    shutil.copy(photographs / "left" / "L1_10ms.png", photographs / "left" / "board_10ms.png")
    shutil.copy(photographs / "left" / "L1_10ms.png", photographs / "left.png")
    said = import_folder(photographs, None, "GBRG", None).missing
    assert "Camera right has no black frame (kind black), without which its zero is unknown." in said
    assert "Camera right has no frame of light L2, which another camera has." in said
    assert any(one.startswith("File left.png names camera left, and neither a light nor a kind") for one in said)
    assert any(one.startswith("Frames of a board are written as comments") for one in said)
    assert "# squares = [?, ?]" in (photographs / "raw.toml").read_text()


def test_an_object_needs_no_teeth(photographs: Path) -> None:
    (photographs / "object").mkdir()
    said = import_folder(photographs, 0.02, "GBRG", None).missing
    assert not any("teeth" in one for one in said)


def test_an_exposure_that_nothing_says(photographs: Path) -> None:
    (photographs / "left" / "L3.png").write_bytes((photographs / "left" / "L1_10ms.png").read_bytes())
    with pytest.raises(CaptureInputError, match=r"File left/L3\.png does not say the exposure; rename .*--exposure-s"):
        import_folder(photographs, None, None, None)
    assert not (photographs / "raw.toml").exists()
    answer = CliRunner().invoke(build_app(), ["import", str(photographs), "--exposure-s", "0.02", "--mosaic", "GBRG"])
    assert answer.exit_code == 0, answer.output
    assert "13 frames of 2 cameras under 3 lights" in answer.output.replace("\n", " ")
    assert read_raw_folder(photographs).frames_of("left", "light")[-1].exposure_s == 0.02


def test_a_folder_without_photographs(tmp_path: Path) -> None:
    with pytest.raises(CaptureInputError, match="holds no photograph of counts; put"):
        import_folder(tmp_path, None, None, None)


def test_tracking_frames_in_one_block_are_told(tmp_path: Path) -> None:
    """The names do not show that these were taken between the lights, so motion would be interpolated where there is
    none.
    """
    for name in ("black", "L1", "L2", "L3", "all0", "all1", "all2", "all3"):
        np.save(tmp_path / f"left_{name}_10ms.npy", counts(1, 1))
    told = import_folder(tmp_path, None, "RGGB", None).missing
    assert any("Tracking frames of camera left all stand before or after its lights" in one for one in told)


def test_lights_that_stand_before_cameras_are_told(tmp_path: Path) -> None:
    for light in ("L1", "L2", "L3"):
        for camera in ("left", "right"):
            np.save(tmp_path / f"{light}_{camera}_10ms.npy", counts(1, 1))
    told = import_folder(tmp_path, None, "RGGB", None).missing
    assert told[0].startswith("Names are read as those of 3 cameras and 2 lights, with the camera first; rename")


def test_a_scan_is_offered_to_be_filled_in(tmp_path: Path) -> None:
    np.save(tmp_path / "left_L1_10ms.npy", counts(1, 1))
    (tmp_path / "upper.stl").write_bytes(b"")
    imported = import_folder(tmp_path, None, "RGGB", None)
    assert imported.missing[-1].endswith("lines to be filled in for upper.stl stand at the end of raw.toml.")
    text = (tmp_path / "raw.toml").read_text()
    assert '# [scan]\n# file = "upper.stl"' in text
    assert "# [[landmark]]" in text
