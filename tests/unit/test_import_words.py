"""No word of a photograph's file name is dropped without a word."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from services.capture.raw.importing import import_folder
from services.capture.raw.names import NamedFrame, named_frame
from services.cli.app import build_app
from services.core.errors import CaptureInputError
from tests.support.raw_folders import counts


def photographs(root: Path, *files: str) -> Path:
    for file in files:
        (root / file).parent.mkdir(parents=True, exist_ok=True)
        np.save(root / file, counts(1, 1))
    return root


@pytest.mark.parametrize(
    ("file", "told", "unused"),
    [
        ("cam_1_L07_0.05s.npy", ("cam1", "L07"), ()),
        ("left_light_07_0.05s_2.npy", ("left", "light07"), ()),
        ("20260114_left_L07_0.05s.npy", ("left", "L07"), ("20260114",)),
        ("2026-01-14/left_L07_12-30-59_0.05s.npy", ("left", "L07"), ("2026-01-14", "12-30-59")),
        ("left_L07_iso800_0.05s.npy", ("left", "L07"), ("iso800",)),
        ("left_L07_upper_f8_0.05s.npy", ("left", "L07"), ("f8", "upper")),
        ("left_ring_07_0.05s.npy", ("left", "ring"), ("07",)),
        ("left_L07_0.05s_3.npy", ("left", "L07"), ()),
        ("left_L07_450nm_0.05s.npy", ("left", "L07-450nm"), ()),
        ("left_650nm_0.05s.npy", ("left", "650nm"), ()),
    ],
)
def test_words_of_a_name(file: str, told: tuple[str, str], unused: tuple[str, ...]) -> None:
    found = named_frame(file)
    assert isinstance(found, NamedFrame)
    assert (found.camera, found.light) == told
    assert found.unused == unused


@pytest.mark.parametrize(
    ("files", "word"),
    [
        (("rig_left_L1_5ms.npy", "rig_left_L2_5ms.npy"), "L1"),
        (("left_L1_iso100_5ms.npy", "left_L1_iso800_5ms.npy"), "iso100"),
        (("left_ring_1_5ms.npy", "left_ring_2_5ms.npy"), "1"),
        (("left_black_5ms.npy", "left_black_warm_5ms.npy"), "warm"),
        (("20260114_left_L1_5ms.npy", "20260115_left_L1_5ms.npy"), "20260114"),
    ],
)
def test_names_that_differ_in_an_ignored_word_are_refused(files: tuple[str, str], word: str, tmp_path: Path) -> None:
    photographs(tmp_path, *files)
    with pytest.raises(CaptureInputError, match=f"Files {files[0]} and {files[1]} differ only in {word}, .*--ignore"):
        import_folder(tmp_path, None, "RGGB", None)
    assert not (tmp_path / "raw.toml").exists()


def test_a_word_may_be_ignored(tmp_path: Path) -> None:
    photographs(tmp_path, "rig_left_L1_5ms.npy", "rig_left_L2_5ms.npy")
    answer = CliRunner().invoke(build_app(), ["import", str(tmp_path), "--mosaic", "RGGB", "--ignore", "Rig"])
    assert answer.exit_code == 0, answer.output
    assert "2 frames of 1 cameras under 2 lights" in answer.output.replace("\n", " ")
    assert "not used" not in answer.output


def test_every_unused_word_is_named(tmp_path: Path) -> None:
    photographs(tmp_path, "20260114_left_L1_iso800_5ms.npy", "20260114_left_L2_iso800_5ms.npy")
    said = import_folder(tmp_path, None, "RGGB", None)
    assert [one.name for one in said.folder.camera] == ["left"]
    assert any("20260114 (2 files), iso800 (2 files)" in one for one in said.missing)


def test_copies_and_the_files_of_systems_are_left_out_and_said(tmp_path: Path) -> None:
    photographs(tmp_path, "left_L1_5ms.npy", "left_L1_5ms (1).npy", "left_L1_5ms - Copy.npy", "Copy of left_L1_5ms.npy")
    photographs(tmp_path, ".Trash/left_L2_5ms.npy", "__MACOSX/left_L3_5ms.npy", "@eaDir/left_L4_5ms.npy")
    photographs(tmp_path, "._left_L5_5ms.npy")
    (tmp_path / "left_L6_5ms.jpg").write_bytes(b"")
    (tmp_path / "left_L6_5ms.xmp").write_bytes(b"")
    (tmp_path / "notes").write_bytes(b"")
    said = import_folder(tmp_path, None, "RGGB", None)
    assert [one.file for one in said.folder.frame] == ["left_L1_5ms.npy"]
    copies, hidden, others = said.missing[:3]
    for file in ("left_L1_5ms (1).npy", "left_L1_5ms - Copy.npy", "Copy of left_L1_5ms.npy"):
        assert file in copies
    for file in (".Trash/left_L2_5ms.npy", "__MACOSX/left_L3_5ms.npy", "@eaDir/left_L4_5ms.npy", "._left_L5_5ms.npy"):
        assert file in hidden
    assert "1 of .jpg, 1 of .xmp, 1 of no suffix" in others


def test_bands_of_one_lamp_are_lights_of_their_own(tmp_path: Path) -> None:
    bands = ("450nm_5ms", "550nm_20ms", "650nm_80ms")
    photographs(tmp_path, *(f"left_lamp_{band}.npy" for band in bands))
    folder = import_folder(tmp_path, None, "RGGB", None).folder
    assert [one.name for one in folder.light] == ["lamp-450nm", "lamp-550nm", "lamp-650nm"]
