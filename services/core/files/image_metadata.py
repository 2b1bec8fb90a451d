"""Find an image's metadata beside its pixels: persons, places, times, devices.

Only the parts that are needed to show the pixels pass; every other part is reported by its name.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

from services.core.files.image_headers import HEADER_BYTES, PNG_SIGNATURE, exr_parts, tiff_layout

_MAX_PARTS = 250_000
_PNG_PLAIN = frozenset(
    b"IHDR PLTE IDAT IEND tRNS cHRM gAMA iCCP sBIT sRGB cICP mDCV cLLI bKGD hIST pHYs sPLT acTL fcTL fdAT".split()
)
_SOFTWARE = b"Software"
_TIFF_PLAIN = frozenset(
    {
        *range(254, 260),  # size, depth, compression, photometry
        *(
            262,
            263,
            264,
            265,
            266,
            273,
            274,
            277,
            278,
            279,
            280,
            281,
            282,
            283,
            284,
            286,
            287,
            288,
            289,
            290,
            291,
            292,
            293,
            296,
            297,
        ),  # strips, orientation
        305,  # the program that wrote it
        *(
            301,
            317,
            318,
            319,
            320,
            321,
            322,
            323,
            324,
            325,
            330,
            332,
            334,
            336,
            338,
            339,
            340,
            341,
            342,
            347,
        ),  # tiles, colours, sample formats
        *(529, 530, 531, 532, 33421, 33422, 34675),  # YCbCr, mosaic, colour profile
    }
)
_SUB_IMAGES = 330
_TIFF_NAMES: Mapping[int, str] = MappingProxyType(
    {
        270: "ImageDescription",
        271: "Make",
        272: "Model",
        285: "PageName",
        306: "DateTime",
        315: "Artist",
        316: "HostComputer",
        700: "XMP",
        33432: "Copyright",
        33723: "IPTC",
        34377: "Photoshop",
        34665: "EXIF",
        34853: "GPS",
        37500: "MakerNote",
        42033: "BodySerialNumber",
    }
)
_EXR_PLAIN = frozenset(
    {
        *(
            "channels",
            "compression",
            "dataWindow",
            "displayWindow",
            "originalDataWindow",
            "lineOrder",
            "pixelAspectRatio",
            "screenWindowCenter",
        ),
        *(
            "screenWindowWidth",
            "tiles",
            "type",
            "name",
            "version",
            "chunkCount",
            "view",
            "multiView",
            "chromaticities",
            "whiteLuminance",
        ),
        *("adoptedNeutral", "envmap", "wrapmodes", "dwaCompressionLevel", "maxSamplesPerPixel"),
    }
)


def metadata_fault(path: Path, name: str, suffix: str) -> str | None:
    """One sentence about metadata of an image that no capture of a person may keep.

    The result is None where the image has no such metadata, or the suffix is that of no known image format.

    Args:
        path: the file.
        name: the image's name in the sentence.
        suffix: suffix of the image's name, in lower case.

    Raises:
        ValueError: the file is no image of that format.
    """
    if suffix not in _READERS:
        return None
    with path.open("rb") as stream:
        try:
            found = sorted(set(_READERS[suffix](stream)))
        except (struct.error, IndexError, KeyError, OverflowError) as problem:
            raise ValueError("its header is cut off or damaged") from problem
    if not found:
        return None
    listed = ", ".join(found[:5]) + (f" and {len(found) - 5} more" if len(found) > 5 else "")
    return (
        f"Image {name} carries metadata ({listed}), which may say whose teeth these are; export it without metadata, or"
        " leave it out."
    )


def plain_png(content: bytes) -> bytes:
    """Copy a PNG with nothing but its header, palette and pixels."""
    kept, place = [PNG_SIGNATURE], len(PNG_SIGNATURE)
    while place < len(content):
        length, kind = struct.unpack_from(">I4s", content, place)
        if kind in {b"IHDR", b"PLTE", b"IDAT", b"IEND"}:
            kept.append(content[place : place + 12 + length])
        if kind == b"IEND":
            break
        place += 12 + length
    return b"".join(kept)


def _png(stream: BinaryIO) -> Iterator[str]:
    size, place = os.fstat(stream.fileno()).st_size, len(PNG_SIGNATURE)
    for _ in range(_MAX_PARTS):
        stream.seek(place)
        head = stream.read(8 + len(_SOFTWARE) + 1)
        if len(head) < 8:
            return
        length, kind = struct.unpack_from(">I4s", head)
        if not kind.isalpha():
            raise ValueError("a part of it is damaged")
        if kind not in _PNG_PLAIN and not (kind == b"tEXt" and head[8:] == _SOFTWARE + b"\0"):
            yield kind.decode()
        place += 12 + length
        if kind == b"IEND":
            if place < size:
                yield f"{size - place} bytes after its end"
            return
    raise ValueError(f"it has more than {_MAX_PARTS} parts")


def _tiff(stream: BinaryIO) -> Iterator[str]:
    # Directories and lists of offsets may overlap, so a small file can hold many long ones; the limit is therefore on
    # their sum.
    layout = tiff_layout(stream.read(16))
    waiting, seen, parts = [layout.start], set[int](), 0
    while waiting:
        start = waiting.pop()
        if start in seen or start == 0:
            continue
        seen.add(start)
        stream.seek(start)
        (count,) = struct.unpack(layout.count, stream.read(struct.calcsize(layout.count)))
        parts = _counted(parts + 1 + count)
        entries = stream.read(count * layout.entry_bytes)
        waiting += struct.unpack(layout.offset, stream.read(struct.calcsize(layout.offset)))
        for place in range(0, count * layout.entry_bytes, layout.entry_bytes):
            (tag,) = struct.unpack_from(f"{layout.order}H", entries, place)
            if tag == _SUB_IMAGES:
                starts = _sub_images(stream, layout.offset, entries[place : place + layout.entry_bytes])
                parts = _counted(parts + len(starts))
                waiting += starts
            elif tag not in _TIFF_PLAIN:
                yield _TIFF_NAMES.get(tag, f"tag {tag}")


def _sub_images(stream: BinaryIO, offset: str, entry: bytes) -> list[int]:
    # A single offset lies in the entry itself; for several, the entry holds the position of their list.
    room = struct.calcsize(offset)
    (count,) = struct.unpack_from(offset, entry, 4)
    (value,) = struct.unpack_from(offset, entry, 4 + room)
    if count == 1:
        return [int(value)]
    stream.seek(value)
    return [one for (one,) in struct.iter_unpack(offset, stream.read(_counted(count) * room))]


def _counted(parts: int) -> int:
    if parts > _MAX_PARTS:
        raise ValueError(f"it has more than {_MAX_PARTS} directories and entries")
    return parts


def _exr(stream: BinaryIO) -> Iterator[str]:
    for attributes in exr_parts(stream.read(HEADER_BYTES)):
        for name in attributes.keys() - _EXR_PLAIN:
            yield repr(name)[1:-1]


_READERS: Mapping[str, Callable[[BinaryIO], Iterator[str]]] = MappingProxyType(
    {".png": _png, ".tif": _tiff, ".tiff": _tiff, ".exr": _exr}
)
