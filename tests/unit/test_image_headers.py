"""What the headers of images declare: checked with files of independent writers, and with headers that lie or are
damaged.
"""

from __future__ import annotations

import json
import struct
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.api.captures.contents import content_fault
from services.core.files.image_headers import declared
from services.core.settings import UploadLimits
from tests.support.uploading import contents_of, write_capture

LIMITS = UploadLimits(largest_image_bytes=10_000)


def exr(*parts: dict[str, tuple[str, bytes]]) -> bytes:
    """The header of an OpenEXR file with these attributes."""
    head = struct.pack("<II", 20000630, 2 | (0x1000 if len(parts) > 1 else 0))
    for part in parts:
        head += (
            b"".join(
                name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
                for name, (kind, value) in part.items()
            )
            + b"\0"
        )
    return head + b"\0"


def exr_part(width: int, height: int, channels: str, kind: int = 1) -> dict[str, tuple[str, bytes]]:
    rows = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", kind, 0, 1, 1) for name in channels) + b"\0"
    return {"channels": ("chlist", rows), "dataWindow": ("box2i", struct.pack("<4i", 5, 5, width + 4, height + 4))}


def png(width: int, height: int, depth: int = 8, colour: int = 2) -> bytes:
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBB", 13, b"IHDR", width, height, depth, colour) + bytes(20)


def tiff(width: int, height: int, order: str = "<", *, big: bool = False) -> bytes:
    """A head of three samples of 16 bits, whose depths do not fit the entry."""
    wide, count, room, first = ("Q", "Q", 8, 16) if big else ("I", "H", 4, 8)
    rows = [(256, 4, [width]), (257, 4, [height]), (258, 3, [16, 16, 16]), (277, 3, [3])]
    at = first + struct.calcsize(count) + len(rows) * (4 + 2 * room) + room
    entries, tail = b"", b""
    for tag, kind, values in rows:
        packed = struct.pack(f"{order}{len(values)}{'H' if kind == 3 else 'I'}", *values)
        if len(packed) > room:
            tail, packed = tail + packed, struct.pack(f"{order}{wide}", at + len(tail))
        entries += struct.pack(f"{order}HH{wide}", tag, kind, len(values)) + packed.ljust(room, b"\0")
    mark = (b"II" if order == "<" else b"MM") + (
        struct.pack(f"{order}HHHQ", 43, 8, 0, 16) if big else struct.pack(f"{order}HI", 42, 8)
    )
    return mark + struct.pack(f"{order}{count}", len(rows)) + entries + bytes(room) + tail


HEADS = [
    (".png", png(40, 30), "40 x 30 pixels of 3 channels", 3600),
    (".png", png(40, 30, 16, 6), "40 x 30 pixels of 4 channels", 9600),
    (".tif", tiff(40, 30), "40 x 30 pixels of 3 channels", 7200),
    (".tiff", tiff(40, 30, ">"), "40 x 30 pixels of 3 channels", 7200),
    (".tif", tiff(40, 30, big=True), "40 x 30 pixels of 3 channels", 7200),
    (".exr", exr(exr_part(40, 30, "BGR")), "40 x 30 pixels of 3 channels", 7200),
    (
        ".exr",
        exr(exr_part(40, 30, "Z", 2), exr_part(4, 3, "Y")),
        "40 x 30 pixels of 1 channels; 4 x 3 pixels of 1 channels",
        4824,
    ),
]


@pytest.mark.parametrize(("suffix", "head", "size", "decoded"), HEADS)
def test_headers_are_read(tmp_path: Path, suffix: str, head: bytes, size: str, decoded: int) -> None:
    path = tmp_path / f"image{suffix}"
    path.write_bytes(head)
    found = declared(path, suffix)
    assert found is not None
    assert (found.size, found.decoded_bytes, found.file_bytes) == (size, decoded, None)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "I;16"])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_headers_of_another_writer_are_read(tmp_path: Path, mode: str, suffix: str) -> None:
    image = pytest.importorskip("PIL.Image", reason="Pillow comes with the extra fit")
    path = tmp_path / f"image{suffix}"
    image.new(mode, (7, 5)).save(path)
    found = declared(path, suffix)
    assert found is not None
    assert found.decoded_bytes == 7 * 5 * {"L": 1, "RGB": 3, "RGBA": 4, "I;16": 2}[mode]


@pytest.mark.parametrize(
    "array", [np.zeros((6, 8, 3), np.float32), np.zeros((6, 8), np.float64, order="F"), np.zeros((), np.uint16)]
)
def test_arrays_state_the_size_of_their_file(tmp_path: Path, array: Any) -> None:
    path = tmp_path / "a.npy"
    np.save(path, array)
    found = declared(path, ".npy")
    assert found is not None
    assert (found.decoded_bytes, found.file_bytes) == (array.nbytes, path.stat().st_size)


def fault(tmp_path: Path, name: str, content: bytes, names: frozenset[str] = frozenset()) -> str | None:
    path = tmp_path / "content"
    path.write_bytes(content)
    return content_fault(path, name, LIMITS, names)


@pytest.mark.parametrize(
    ("suffix", "bomb"),
    [
        (".png", png(60_000, 60_000)),
        (".tif", tiff(60_000, 60_000)),
        (".exr", exr(exr_part(60_000, 60_000, "BGR"))),
        (".png", png(2**32 - 1, 2**32 - 1)),
    ],
)
@pytest.mark.attack("uploads", "an image that decodes to more than memory")
def test_bombs_are_refused_by_name(tmp_path: Path, suffix: str, bomb: bytes) -> None:
    detail = fault(tmp_path, f"c0{suffix}", bomb)
    assert detail is not None
    assert detail.startswith(f"Image c0{suffix} declares")
    assert "more than 10000 bytes when decoded" in detail


def test_a_size_that_the_file_cannot_hold_is_refused(tmp_path: Path) -> None:
    stream = BytesIO()
    np.save(stream, np.zeros((4, 4), np.float32))
    assert fault(tmp_path, "a.npy", stream.getvalue()) is None
    assert "bytes instead of" in (fault(tmp_path, "a.npy", stream.getvalue()[:-1]) or "")
    limits = UploadLimits()
    (tmp_path / "content").write_bytes(png(10_000, 10_000))
    assert "which no photograph packs to" in (content_fault(tmp_path / "content", "a.png", limits, frozenset()) or "")


@pytest.mark.attack("uploads", "an array with Python objects (pickle)")
def test_python_objects_are_refused(tmp_path: Path) -> None:
    stream = BytesIO()
    np.save(stream, np.array([{}], dtype=object), allow_pickle=True)
    assert "Python objects" in (fault(tmp_path, "a.npy", stream.getvalue()) or "")


@settings(deadline=None)
@given(st.sampled_from(HEADS), st.integers(0, 60), st.binary(max_size=8))
@pytest.mark.attack("uploads", "a damaged header")
def test_damaged_headers_are_a_sentence_or_harmless(
    tmp_path_factory: pytest.TempPathFactory, row: Any, at: int, noise: bytes
) -> None:
    suffix, head = row[0], row[1]
    damaged = (head[:at] + noise + head[at + len(noise) :]) if noise else head[:at]
    detail = fault(tmp_path_factory.mktemp("damaged"), f"image{suffix}", damaged)
    assert detail is None or detail.startswith(
        (f"image{suffix} cannot be read", f"Image image{suffix} declares", f"Image image{suffix} carries metadata")
    )


@settings(deadline=None)
@given(st.sampled_from([".npy", ".png", ".tif", ".exr"]), st.binary(max_size=200))
@pytest.mark.attack("uploads", "noise for an image")
def test_noise_is_no_image(tmp_path_factory: pytest.TempPathFactory, suffix: str, noise: bytes) -> None:
    assert (fault(tmp_path_factory.mktemp("noise"), f"image{suffix}", noise) or "").startswith(
        f"image{suffix} cannot be read"
    )


def test_a_description_is_checked_against_the_files(tmp_path: Path) -> None:
    contents = contents_of(write_capture(tmp_path / "mine"))
    text, names = contents["capture.json"], frozenset(contents)
    assert fault(tmp_path, "capture.json", text, names) is None
    assert "names image file c0_l1.npy" in (fault(tmp_path, "capture.json", text, names - {"c0_l1.npy"}) or "")
    assert "camera c0 has 8000000 x 6" in (
        fault(tmp_path, "capture.json", text.replace(b"[8, 6]", b"[8000000, 6]"), names) or ""
    )
    assert "units" in (fault(tmp_path, "capture.json", text.replace(b'"mm"', b'"inch"'), names) or "")
    assert "cannot be read" in (fault(tmp_path, "zarr.json", b"[" * 100_000, names) or "")


def test_chunks_of_arrays_are_limited(tmp_path: Path) -> None:
    array: dict[str, Any] = {
        "node_type": "array",
        "data_type": "uint16",
        "chunk_grid": {"configuration": {"chunk_shape": [1, 1, 50, 50, 2]}},
    }
    assert fault(tmp_path, "capture.zarr/zarr.json", json.dumps(array).encode()) is None
    array["chunk_grid"]["configuration"]["chunk_shape"][0] = 2
    assert "2 x 1 x 50 x 50 x 2 numbers" in (
        fault(tmp_path, "capture.zarr/zarr.json", json.dumps(array).encode()) or ""
    )
    assert "cannot be read" in (fault(tmp_path, "capture.zarr/zarr.json", b"{}") or "")
    assert "cannot be read" in (fault(tmp_path, "manifest.json", b"[]") or "")
