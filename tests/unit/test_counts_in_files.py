"""What a PNG, TIFF, OpenEXR or camera raw file must say to be counts; everything else is refused by its name."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from services.core.raw.decoding import decode
from tests.support.dng_files import write_dng
from tests.support.shared_data import shared_path

GREY = np.random.default_rng(1).integers(0, 4000, (48, 64)).astype(np.uint16)
COLOURS = np.random.default_rng(2).integers(0, 4000, (48, 64, 3)).astype(np.uint16)
Write = Callable[[Path], object]


def tif(values: Any, **options: Any) -> Write:
    return lambda folder: tifffile.imwrite(folder / "x.tif", values, **options)


def pages(*values: Any, kinds: tuple[int, ...] = (), sub: int = 0) -> Write:
    def write(folder: Path) -> None:
        with tifffile.TiffWriter(folder / "x.tif") as file:
            for k, one in enumerate(values):
                file.write(one, photometric="minisblack", subfiletype=1, subifds=sub if k == 0 else 0)
        with tifffile.TiffFile(folder / "x.tif", mode="r+b") as file:
            for k, page in enumerate(
                [*file.pages, *(inner for one in file.pages for inner in one.aspage().pages or ())]
            ):
                page.aspage().tags[254].overwrite(kinds[k] if kinds else 0)

    return write


def retagged(tag: int, value: int, values: Any = GREY, photometric: str = "minisblack") -> Write:
    """A good TIFF one of whose tags was changed in place."""

    def write(folder: Path) -> None:
        tifffile.imwrite(folder / "x.tif", values, photometric=photometric, rowsperstrip=8)
        with tifffile.TiffFile(folder / "x.tif", mode="r+b") as file:
            file.pages.first.tags[tag].overwrite(value)

    return write


def without_last_strips(folder: Path) -> None:
    tifffile.imwrite(folder / "x.tif", GREY, photometric="minisblack", rowsperstrip=8, compression="zlib")
    with tifffile.TiffFile(folder / "x.tif", mode="r+b") as file:
        tags = file.pages.first.tags
        tags[279].overwrite((*tags[279].value[:4], 0, 0))
        tags[273].overwrite((*tags[273].value[:4], 0, 0))


def png(values: Any, *added: tuple[bytes, bytes]) -> Write:
    """A PNG by OpenCV with more parts after its header."""

    def write(folder: Path) -> None:
        content = cv2.imencode(".png", values)[1].tobytes()
        parts = b"".join(
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
            for kind, body in added
        )
        (folder / "x.png").write_bytes(content[:33] + parts + content[33:])

    return write


def palette(folder: Path) -> None:
    from PIL import Image

    Image.fromarray((GREY % 256).astype(np.uint8)).convert("P").save(folder / "x.png")


def exr(**header: Any) -> Write:
    def write(folder: Path) -> None:
        import OpenEXR

        channels = header.pop("channels", {"RGB": COLOURS.astype(np.float32)})
        full = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage} | header
        OpenEXR.File(full, channels).write(str(folder / "x.exr"))

    return write


def two_parts(folder: Path) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    parts = [
        OpenEXR.Part(header | {"name": name}, {"RGB": COLOURS.astype(np.float32)}, name) for name in ("left", "right")
    ]
    OpenEXR.File(parts).write(str(folder / "x.exr"))


def lossy_exr(folder: Path) -> None:
    import OpenEXR

    exr(compression=OpenEXR.DWAA_COMPRESSION)(folder)


ALPHA = np.ones((48, 64), dtype=np.float32) * 0.5
REFUSED: dict[str, tuple[Write, str]] = {
    "inverted greys": (tif(GREY, photometric="miniswhite"), "inverted greys"),
    "a palette of a TIFF": (
        tif((GREY % 256).astype(np.uint8), photometric="palette", colormap=np.zeros((3, 256), np.uint16)),
        "a palette",
    ),
    "YCbCr": (retagged(262, 6, COLOURS, "rgb"), "YCbCr"),
    "Lab": (retagged(262, 8, COLOURS, "rgb"), "CIE Lab"),
    "inks": (tif(np.dstack([GREY] * 4), photometric="separated"), "inks"),
    "an unknown meaning": (retagged(262, 77), "unknown meaning 77"),
    "several pages": (pages(GREY, GREY, GREY), r'3 pictures.*tiffcp "x\.tif,0" one\.tif'),
    "several pages of one series": (tif(np.stack([GREY, GREY]), photometric="minisblack"), "2 pictures"),
    "pages without directories of their own": (
        tif(np.stack([GREY, GREY]), photometric="minisblack", imagej=True), "several pictures|2 pictures",
    ),
    "a picture below another": (pages(GREY[:24], GREY, sub=1), "2 pictures"),
    "nothing but a thumbnail": (pages(GREY, kinds=(1,)), "reduced size"),
    "a mask beside the picture": (pages(GREY, GREY, kinds=(0, 4)), "transparency mask"),
    "alpha of a TIFF": (tif(np.dstack([COLOURS, GREY]), photometric="rgb"), "alpha channel"),
    "strips that were never written": (without_last_strips, "lacks 2 of its 6 strips"),
    "fewer strips than rows": (retagged(278, 4), "lacks 6 of its 12|cannot be read"),
    "a palette of a PNG": (palette, "a palette"),
    "alpha of a PNG": (png(np.dstack([COLOURS, GREY])), "alpha channel"),
    "transparent colours": (png(GREY, (b"tRNS", b"\0\1")), "transparent"),
    "an animation": (png(GREY, (b"acTL", struct.pack(">II", 2, 0))), "several pictures"),
    "EXR of two parts": (two_parts, r"2 parts \(left, right\)"),
    "EXR of two views": (exr(multiView=["left", "right"]), r"several views \(left, right\)"),
    "EXR of wide pixels": (exr(pixelAspectRatio=2.0), "2 times as wide as high"),
    "EXR with alpha": (exr(channels={"RGBA": np.dstack([COLOURS.astype(np.float32), ALPHA])}), "alpha channel"),
    "EXR with loss": (lossy_exr, "DWAA_COMPRESSION"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_a_file_that_is_no_counts_is_refused_by_its_name(case: str, tmp_path: Path) -> None:
    write, words = REFUSED[case]
    write(tmp_path)
    (path,) = tmp_path.iterdir()
    with pytest.raises(ValueError, match=words) as caught:
        decode(path)
    assert "; " in str(caught.value), "a remedy is named"


def xres(folder: Path) -> None:
    tifffile.imwrite(folder / "x.tif", GREY, photometric="minisblack", byteorder=">", bigtiff=True, tile=(16, 16))


KEPT: dict[str, tuple[Write, np.ndarray]] = {
    "a big-endian TIFF in tiles": (xres, GREY),
    "a picture after its thumbnail": (pages(GREY[::8, ::8].copy(), GREY, kinds=(1, 0)), GREY),
    "a TIFF of five channels": (
        tif(np.dstack([GREY] * 5), photometric="minisblack", planarconfig="contig"), np.dstack([GREY] * 5),
    ),
    "a mosaic in a TIFF": (tif(GREY, photometric="cfa"), GREY),
    "a grey PNG with a scale": (png(GREY, (b"pHYs", struct.pack(">IIB", 1000, 1000, 1))), GREY),
    "a big-endian NPY": (lambda folder: np.save(folder / "x.npy", GREY.astype(">u2")), GREY),
    "an EXR whose alpha is 1": (
        exr(channels={"RGBA": np.dstack([COLOURS, np.ones_like(GREY)]).astype(np.float32)}),
        COLOURS[..., ::-1].astype(np.float32),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", KEPT)
def test_good_files_stay_readable(case: str, tmp_path: Path) -> None:
    write, known = KEPT[case]
    write(tmp_path)
    (path,) = tmp_path.iterdir()
    found = decode(path)
    np.testing.assert_array_equal(found.values, known)
    assert found.values.dtype == known.dtype


def test_the_data_window_of_an_exr_is_placed(tmp_path: Path) -> None:
    corner = np.array([70, 50], np.int32)
    exr(
        dataWindow=(np.array([7, 3], np.int32), np.array([70, 50], np.int32)),
        displayWindow=(np.array([0, 0], np.int32), corner + 9),
    )(tmp_path)
    found = decode(tmp_path / "x.exr")
    assert found.values.shape == (60, 80, 3)
    assert found.window == (3, 51, 7, 71)
    np.testing.assert_array_equal(found.values[3:51, 7:71], COLOURS[..., ::-1])
    assert found.values.sum() == COLOURS.sum(dtype=np.float64)


def test_a_data_window_beyond_the_display_window_is_cut(tmp_path: Path) -> None:
    exr(
        dataWindow=(np.array([0, 0], np.int32), np.array([63, 47], np.int32)),
        displayWindow=(np.array([5, 6], np.int32), np.array([60, 40], np.int32)),
    )(tmp_path)
    found = decode(tmp_path / "x.exr")
    assert found.window is None
    np.testing.assert_array_equal(found.values, COLOURS[6:41, 5:61, ::-1])


def dng(pattern: tuple[int, ...], **changed: Any) -> Write:
    return lambda folder: write_dng(folder / "x.dng", np.repeat(GREY, 2, axis=0)[:96], pattern, **changed)


XTRANS = "GBGGRG RGRBGB GBGGRG GRGGBG BGBRGR GRGGBG".replace(" ", "")


@pytest.mark.parametrize("phase", range(36))
def test_a_mosaic_of_six_pixels_is_no_bayer_mosaic(phase: int, tmp_path: Path) -> None:
    shift = divmod(phase, 6)
    letters = np.roll(np.array(list(XTRANS)).reshape(6, 6), shift, axis=(0, 1))
    dng(tuple("RGB".index(one) for one in letters.ravel()), repeat=(6, 6))(tmp_path)
    with pytest.raises(ValueError, match="repeat after 6 x 6 pixels"):
        decode(tmp_path / "x.dng")


FILTERS: dict[str, tuple[Write, str]] = {
    "quad Bayer": (dng(tuple(map("RGB".index, "RRGGRRGGGGBBGGBB")), repeat=(4, 4)), "repeat after 4 x 4 pixels"),
    "cyan, magenta, yellow": (dng((0, 1, 1, 2), planes=(3, 4, 5)), "C, M, Y"),
    "white beside red, green, blue": (dng((0, 1, 3, 2), planes=(0, 1, 2, 6)), "filters W"),
    "a mosaic of four colours in a TIFF": (
        tif(GREY, photometric="cfa", extratags=[(33421, "H", 2, (2, 2), True), (33422, "B", 4, b"\0\1\6\2", True)]),
        "filters W",
    ),
    "two reds": (dng((0, 1, 0, 2)), "RGRB"),
}  # fmt: skip


@pytest.mark.parametrize("case", FILTERS)
def test_other_colour_filters_are_refused_by_their_name(case: str, tmp_path: Path) -> None:
    write, words = FILTERS[case]
    write(tmp_path)
    (path,) = tmp_path.iterdir()
    with pytest.raises(ValueError, match=words) as caught:
        decode(path)
    assert "cannot be read" not in str(caught.value)


def test_the_white_level_of_a_raw_file_is_read(tmp_path: Path) -> None:
    dng((0, 1, 1, 2), white=3240)(tmp_path)
    assert decode(tmp_path / "x.dng").white == (3240.0,) * 4


STRANGE = {
    "tiff-png/tif-minwhite.tif": "inverted greys",
    "tiff-png/tif-multipage.tif": "3 pictures",
    "tiff-png/tif-sparse.tif": "lacks 2 of its 6 strips",
    "tiff-png/tif-rgba.tif": "alpha",
    "tiff-png/png-ga.png": "alpha",
    "tiff-png/png-palette.png": "palette",
    "exr/MultiView_Fog.exr": "several views",
    "colour-filter/xtrans-rggb.dng": "6 x 6",
}


@pytest.mark.parametrize("file", STRANGE)
def test_files_of_strangers(file: str) -> None:
    with pytest.raises(ValueError, match=STRANGE[file]):
        decode(shared_path("data/strangers-files") / file)


def test_good_files_of_strangers() -> None:
    root = shared_path("data/strangers-files")
    assert decode(root / "tiff-png" / "tif-thumbfirst.tif").values.shape == (48, 64, 3)
    assert decode(root / "tiff-png" / "tif-be.tif").values.shape == (48, 64)
    found = decode(root / "exr" / "DisplayWindow_t08.exr")
    assert found.values.shape == (401, 501, 3)
    assert found.window == (40, 340, 30, 430)
