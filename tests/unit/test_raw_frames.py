"""Counts of raw frames, read with the library of each format; an independent library writes the files where there is
one.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from services.core.errors import CaptureInputError
from services.core.raw.folder import read_raw_folder
from services.core.raw.frames import read_counts
from services.core.raw.mosaic import binned, site_channels, sites
from tests.support.dng_files import write_dng
from tests.support.raw_folders import SIZE, Tree, counts, write_raw_folder, write_toml

Write = Callable[[Path, Any], object]
KNOWN = counts(7)
MOSAIC = counts(8, channels=1)[..., 0]


def write_exr(path: Path, values: Any) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": values.astype(np.float32)}) as file:
        file.write(str(path))


WRITERS: dict[str, tuple[str, Write]] = {
    "png by OpenCV": ("x.png", lambda path, values: cv2.imwrite(str(path), values[..., ::-1])),
    "tiff by OpenCV": ("x.tif", lambda path, values: cv2.imwrite(str(path), values[..., ::-1])),
    "tiff, deflated in tiles": (
        "x.tiff",
        lambda path, values: tifffile.imwrite(path, values, photometric="rgb", compression="zlib", tile=(16, 16)),
    ),
    "tiff, plane by plane": (
        "x.tif",
        lambda path, values: tifffile.imwrite(
            path, np.moveaxis(values, -1, 0), photometric="rgb", planarconfig="separate"
        ),
    ),
    "npy": ("x.npy", np.save),
    "exr": ("x.exr", write_exr),
}


def folder_with(root: Path, file: str, write: Write, values: Any, **camera: Any) -> Tree:
    """A raw folder whose second frame is this file."""
    tree = write_raw_folder(root)
    write(root / file, values)
    tree["frame"][1]["file"] = file
    tree["camera"][0].update(camera)
    write_toml(root, tree)
    return tree


@pytest.mark.parametrize("case", WRITERS)
def test_colour_counts_are_read_as_they_were_written(case: str, tmp_path: Path) -> None:
    file, write = WRITERS[case]
    folder_with(tmp_path, file, write, KNOWN)
    folder = read_raw_folder(tmp_path)
    read = read_counts(tmp_path, folder, folder.frame[1])
    assert read.dtype == (np.float32 if file.endswith("exr") else np.uint16)
    np.testing.assert_array_equal(read, KNOWN)


@pytest.mark.parametrize("file", ["x.png", "x.tif"])
def test_mosaics_of_8_bits_are_read(file: str, tmp_path: Path) -> None:
    values = (MOSAIC >> 4).astype(np.uint8)
    folder_with(tmp_path, file, lambda path, image: cv2.imwrite(str(path), image), values, mosaic="GBRG", bits=8)
    folder = read_raw_folder(tmp_path)
    np.testing.assert_array_equal(read_counts(tmp_path, folder, folder.frame[1]), values)


@pytest.mark.parametrize(("mosaic", "pattern"), [("RGGB", (0, 1, 1, 2)), ("GBRG", (1, 2, 0, 1))])
def test_a_camera_raw_file_by_another_writer_has_its_counts(
    mosaic: str, pattern: tuple[int, ...], tmp_path: Path
) -> None:
    values = np.random.default_rng(5).integers(64, 4096, (48, 64)).astype(np.uint16)
    tree = folder_with(
        tmp_path, "x.dng", lambda path, image: write_dng(path, image, pattern, tile=(48, 64)), values, mosaic=mosaic
    )
    tree["camera"][0]["size"] = [64, 48]
    write_toml(tmp_path, tree)
    folder = read_raw_folder(tmp_path)
    np.testing.assert_array_equal(read_counts(tmp_path, folder, folder.frame[1]), values)
    tree["camera"][0]["mosaic"] = "BGGR"
    write_toml(tmp_path, tree)
    folder = read_raw_folder(tmp_path)
    with pytest.raises(CaptureInputError, match=rf"x\.dng .* begins {mosaic}, but its camera's begins BGGR"):
        read_counts(tmp_path, folder, folder.frame[1])


def test_counts_in_the_high_bits_are_moved_down(tmp_path: Path) -> None:
    folder_with(tmp_path, "x.png", lambda path, values: cv2.imwrite(str(path), values[..., ::-1] << 4), KNOWN, shift=4)
    folder = read_raw_folder(tmp_path)
    np.testing.assert_array_equal(read_counts(tmp_path, folder, folder.frame[1]), KNOWN)


def test_channels_come_in_the_order_of_the_first_camera(tmp_path: Path) -> None:
    tree = write_raw_folder(tmp_path)
    tree["camera"][1]["channels"] = ["blue", "red", "green"]
    write_toml(tmp_path, tree)
    folder = read_raw_folder(tmp_path)
    read = read_counts(tmp_path, folder, folder.frames_of("right", "light")[0])
    np.testing.assert_array_equal(read, np.load(tmp_path / "right_L1.npy")[..., [1, 2, 0]])


def save(file: str, make: Callable[[Any], Any], **camera: Any) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        folder_with(root, file, lambda path, values: np.save(path, make(values)), KNOWN, **camera)

    return damage


def truncate(file: str, write: Write, share: float) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        folder_with(root, file, write, KNOWN)
        content = (root / file).read_bytes()
        (root / file).write_bytes(content[: int(share * len(content))])

    return damage


def as_bytes(file: str, content: bytes) -> Callable[[Path], None]:
    def damage(root: Path) -> None:
        folder_with(root, file, lambda path, _: path.write_bytes(content), KNOWN)

    return damage


def jpeg() -> bytes:
    return bytes(cv2.imencode(".jpg", (KNOWN >> 4).astype(np.uint8))[1])


def other_mosaic(root: Path) -> None:
    image = np.full((SIZE[1], SIZE[0]), 1000, dtype=np.uint16)
    image[0::2, 1::2], image[1::2, 0::2] = 2000, 500
    folder_with(root, "x.npy", np.save, image, mosaic="RGGB")


BAD: dict[str, tuple[Callable[[Path], object], str]] = {
    "PNG cut off": (truncate("x.png", WRITERS["png by OpenCV"][1], 0.6), r"x\.png .*cannot be read .*may be truncated"),
    "TIFF cut off": (
        truncate("x.tif", WRITERS["tiff by OpenCV"][1], 0.6),
        r"x\.tif .*cannot be read .*may be truncated",
    ),
    "NPY cut off": (truncate("x.npy", np.save, 0.6), r"x\.npy .*cannot be read .*may be truncated"),
    "EXR cut off": (truncate("x.exr", write_exr, 0.6), r"x\.exr .*cannot be read .*may be truncated"),
    "empty": (as_bytes("x.png", b""), r"x\.png \(camera left, light L1\) is empty"),
    "JPEG": (as_bytes("x.jpg", jpeg()), r"x\.jpg .* is a JPEG, whose values are no counts"),
    "JPEG under another name": (as_bytes("x.png", jpeg()), r"x\.png .* is a JPEG"),
    "noise for a raw file": (as_bytes("x.nef", bytes(range(256)) * 8), r"x\.nef .*cannot be read"),
    "text for a PNG": (as_bytes("x.png", b"hello, this is a text"), r"x\.png .* is no PNG file inside"),
    "unknown format": (
        as_bytes("x.gif", b"GIF89a" + bytes(90)),
        r"x\.gif .*not read; export it as one of \.exr, \.npy",
    ),
    "another size": (save("x.npy", lambda v: v[:-1]), r"has 24 x 15 pixels, but its camera has 24 x 16"),
    "turned": (save("x.npy", lambda v: v.transpose(1, 0, 2)), r"has 16 x 24 pixels \(turned by 90 degrees\?\)"),
    "one channel": (
        save("x.npy", lambda v: v[..., 0]),
        r"has one number a pixel.*channels = \W\Wgrey",
    ),
    "colour for a mosaic": (save("x.npy", lambda v: v, mosaic="RGGB"), r"has 3 channels, but .* a mosaic of one"),
    "more than its bits": (
        save("x.npy", lambda v: v << 4),
        r"holds a count of \d+, more than the 12 bits of its camera",
    ),
    "fewer than its bits": (
        save("x.npy", lambda v: (v >> 4).astype(np.uint8)),
        r"has 8 bits a count, but its camera has 12; export it at the camera's depth",
    ),
    "32 bits": (save("x.npy", lambda v: v.astype(np.int32)), r"holds numbers of type int32; export whole numbers"),
    "bits not said": (save("x.npy", lambda v: v, bits=None), r"give the camera its bits"),
    "NaN": (
        save("x.npy", lambda v: np.where(v > 2900, np.nan, v).astype(np.float32)),
        r"has \d+ values that are no finite",
    ),
    "objects": (save("x.npy", lambda v: v.astype(object)), r"x\.npy .*cannot be read"),
    "wrong mosaic": (other_mosaic, r"green pixels that differ by \d+%, so it does not begin RGGB; correct mosaic"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_frame_is_named(case: str, tmp_path: Path) -> None:
    damage, pattern = BAD[case]
    damage(tmp_path)
    text = (tmp_path / "raw.toml").read_text().replace("bits = None\n", "")
    (tmp_path / "raw.toml").write_text(text)
    folder = read_raw_folder(tmp_path)
    with pytest.raises(CaptureInputError, match=pattern) as caught:
        read_counts(tmp_path, folder, folder.frame[1])
    assert "(camera left, light L1)" in caught.value.message
    assert caught.value.message.endswith(".")
    assert "\n" not in caught.value.message


def test_the_pixels_of_a_mosaic_by_colour() -> None:
    np.testing.assert_array_equal(site_channels("GBRG"), [[1, 2], [0, 1]])
    image = np.array([[10, 20], [30, 14]], dtype=np.uint16)
    assert [(channel, int(view[0, 0])) for channel, view in sites(image, "GBRG")] == [
        (1, 10),
        (2, 20),
        (0, 30),
        (1, 14),
    ]
    np.testing.assert_array_equal(binned(image, "GBRG"), [[[30.0, 12.0, 20.0]]])
