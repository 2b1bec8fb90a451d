"""Metadata in images: found in files of independent writers; pictures made here have none."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.core.files.image_metadata import metadata_fault, plain_png
from services.core.pages.pictures import png16_bytes, png_bytes
from services.preprocess.quality.images import write_picture
from tests.support.told_images import XMP, Image, PngInfo, exif, told_png, with_text, written
from tests.unit.test_image_headers import exr, exr_part


def fault(tmp_path: Path, suffix: str, content: bytes) -> str | None:
    path = tmp_path / "content"
    path.write_bytes(content)
    return metadata_fault(path, f"c0{suffix}", suffix)


def text(value: bytes) -> tuple[str, bytes]:
    return "string", value


@pytest.mark.parametrize(
    ("suffix", "content", "named"),
    [
        (".png", told_png(), "eXIf, iTXt, tEXt"),
        (".png", written(".png") + b"more", "4 bytes after its end"),
        (".tif", written(".tif", exif=exif()), "EXIF, GPS, Make"),
        (".tif", written(".tif", tiffinfo={700: XMP.encode()}), "XMP"),
        (".tif", written(".tif", tiffinfo={50735: "0123456"}), "tag 50735"),
        (
            ".exr",
            exr(exr_part(4, 3, "BGR") | {"owner": text(b"A name"), "latitude": ("float", bytes(4))}),
            "latitude, owner",
        ),
        (".exr", exr(exr_part(4, 3, "Z"), exr_part(4, 3, "Y") | {"capDate": text(b"2026:11:22")}), "capDate"),
    ],
)
def test_metadata_is_named(tmp_path: Path, suffix: str, content: bytes, named: str) -> None:
    remedy = "which may say whose teeth these are; export it without metadata, or leave it out."
    assert fault(tmp_path, suffix, content) == f"Image c0{suffix} carries metadata ({named}), {remedy}"


def test_metadata_of_a_second_image_in_a_tiff_is_named(tmp_path: Path) -> None:
    stream, second = BytesIO(), Image.new("L", (7, 5))
    second.encoderinfo = {"tiffinfo": {315: "A name"}}
    Image.new("L", (7, 5)).save(stream, format="TIFF", save_all=True, append_images=[second])
    assert "(Artist)" in (fault(tmp_path, ".tif", stream.getvalue()) or "")


@pytest.mark.attack("uploads", "a TIFF of many long directories")
def test_a_small_tiff_of_many_long_directories_is_refused_before_all_are_read(tmp_path: Path) -> None:
    # 300 directories of 65,535 entries each, each beginning two bytes after the one before: twenty million entries in
    # 0.8 MB.
    many, most = 300, 2**16 - 1
    list_at = 8 + 2 + 12 + 4
    first = list_at + 4 * many
    head = b"II" + struct.pack("<HI", 42, 8) + struct.pack("<HHHIII", 1, 330, 4, many, list_at, 0)
    starts = struct.pack(f"<{many}I", *range(first, first + 2 * many, 2))
    with pytest.raises(ValueError, match="more than 250000 directories and entries"):
        fault(tmp_path, ".tif", head + starts + b"\xff\xff" * many + bytes(12 * most + 4))


@pytest.mark.attack("uploads", "a TIFF that names one list again and again")
def test_a_small_tiff_that_names_one_long_list_of_directories_again_and_again_is_refused(tmp_path: Path) -> None:
    entries, list_at = 1000, 8 + 2 + 12 * 1000 + 4
    head = (
        b"II"
        + struct.pack("<HI", 42, 8)
        + struct.pack("<H", entries)
        + struct.pack("<HHII", 330, 4, 200_000, list_at) * entries
    )
    with pytest.raises(ValueError, match="more than 250000 directories and entries"):
        fault(tmp_path, ".tif", head + bytes(4) + bytes(4 * 200_000))


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "I;16", "P"])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_plain_images_pass(tmp_path: Path, suffix: str, mode: str) -> None:
    software = PngInfo()
    software.add_text("Software", "a program")
    options: dict[str, Any] = (
        {"pnginfo": software} if suffix == ".png" else {"software": "a program", "compression": "tiff_lzw"}
    )
    assert fault(tmp_path, suffix, written(suffix, mode, **options)) is None


def test_a_plain_exr_passes(tmp_path: Path) -> None:
    assert (
        fault(tmp_path, ".exr", exr(exr_part(4, 3, "BGR") | {"pixelAspectRatio": ("float", struct.pack("<f", 1))}))
        is None
    )
    assert metadata_fault(tmp_path / "absent", "a.npy", ".npy") is None


@settings(deadline=None)
@given(
    st.sampled_from([(".png", told_png()), (".tif", written(".tif", exif=exif()))]),
    st.integers(0, 400),
    st.binary(max_size=8),
)
def test_damage_is_a_sentence_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, row: tuple[str, bytes], at: int, noise: bytes
) -> None:
    suffix, content = row
    try:
        told = fault(
            tmp_path_factory.mktemp("damaged"),
            suffix,
            content[:at] + noise + content[at + len(noise) :] if noise else content[:at],
        )
    except ValueError as problem:
        told = str(problem)
    assert told is None or told


def test_a_png_is_stripped_and_shows_the_same(tmp_path: Path) -> None:
    before = png_bytes(np.random.default_rng(1).integers(0, 255, (6, 8, 3), dtype=np.uint8))
    told = with_text(before, b"Author\0A name")
    assert "(tEXt)" in (fault(tmp_path, ".png", told) or "")
    assert plain_png(told + b"more") == before


def test_pictures_made_here_say_nothing(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    write_picture(tmp_path / "quality.png", rng.random((12, 8, 3), dtype=np.float32), np.zeros((12, 8), np.uint16))
    for content in (
        png_bytes(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8)),
        png16_bytes(rng.random((6, 8))),
        (tmp_path / "quality.png").read_bytes(),
    ):
        assert fault(tmp_path, ".png", content) is None
