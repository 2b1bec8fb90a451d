"""Read the size that an image declares, from its header alone; nothing is decoded."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from types import MappingProxyType

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
HEADER_BYTES = 2**20
"""Number of bytes that are read from the beginning of a file; a header must lie within them."""


@dataclass(frozen=True)
class Declared:
    """The sizes that an image's header declares."""

    size: str
    """Size of the image in words, such as 4000 x 3000 pixels of 3 channels."""
    decoded_bytes: int
    file_bytes: int | None = None
    """Size of the file if the format fixes it."""


@dataclass(frozen=True)
class PngHeader:
    """The header of a PNG; depth is in bits per channel, colour its code."""

    width: int
    height: int
    depth: int
    colour: int
    is_interlaced: bool


def declared(path: Path, suffix: str) -> Declared | None:
    """Read an image's header; None where the suffix is that of no known image format.

    Raises:
        ValueError: the file is no image of that format.
    """
    if suffix not in _READERS:
        return None
    with path.open("rb") as stream:
        head = stream.read(HEADER_BYTES)
    try:
        return _READERS[suffix](head)
    except (struct.error, IndexError, KeyError, OverflowError) as problem:
        raise ValueError("its header is cut off or damaged") from problem


def _pixels(width: int, height: int, channels: int, channel_bytes: int) -> Declared:
    if min(width, height, channels, channel_bytes) < 1:
        raise ValueError("its header declares no pixels")
    return Declared(f"{width} x {height} pixels of {channels} channels", width * height * channels * channel_bytes)


def _npy(head: bytes) -> Declared:
    from numpy.lib import format as npy

    stream = BytesIO(head)
    version = npy.read_magic(stream)
    if version not in {(1, 0), (2, 0)}:
        raise ValueError(f"it is of version {version[0]}.{version[1]} and 1.0 and 2.0 are read")
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(stream)
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are never loaded")
    if any(length < 0 for length in shape):
        raise ValueError("its header declares a negative length")
    array_bytes = math.prod(shape) * dtype.itemsize
    return Declared(
        f"{' x '.join(map(str, shape)) or 'one'} numbers of {dtype.itemsize} bytes",
        array_bytes,
        stream.tell() + array_bytes,
    )


def png_header(head: bytes) -> PngHeader:
    """Read the header of a PNG from its first bytes.

    Raises:
        ValueError: the bytes are not those of a PNG. struct.error: the header is cut off.
    """
    if head[:8] != PNG_SIGNATURE or head[12:16] != b"IHDR":
        raise ValueError("it is no PNG")
    width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", head[16:29])
    return PngHeader(width, height, depth, colour, is_interlaced=interlace != 0)


def _png(head: bytes) -> Declared:
    header = png_header(head)
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}[header.colour]  # a palette decodes to three channels
    return _pixels(header.width, header.height, channels, -(-header.depth // 8))


@dataclass(frozen=True)
class TiffLayout:
    """How a TIFF's directories are written: byte order, ``struct`` formats of a count of entries and of an offset,
    size of an entry, and position of the first directory.
    """

    order: str
    count: str
    offset: str
    entry_bytes: int
    start: int


def tiff_layout(head: bytes) -> TiffLayout:
    """Read the layout of a TIFF from its first 16 bytes.

    Raises:
        ValueError: the bytes are not those of a TIFF. struct.error: the header is cut off.
    """
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    (magic,) = struct.unpack_from(f"{order or '<'}H", head, 2)
    if order is None or magic not in {42, 43}:
        raise ValueError("it is no TIFF")
    is_big = magic == 43
    offset_at, offset_code, count_code, entry_bytes = (8, "Q", "Q", 20) if is_big else (4, "I", "H", 12)
    (start,) = struct.unpack_from(f"{order}{offset_code}", head, offset_at)
    return TiffLayout(order, f"{order}{count_code}", f"{order}{offset_code}", entry_bytes, start)


def _tiff(head: bytes) -> Declared:
    layout = tiff_layout(head)
    if layout.start >= len(head):
        raise ValueError(
            f"its directory lies beyond the first {HEADER_BYTES} bytes; write it with the directory in front"
        )
    (count,) = struct.unpack_from(layout.count, head, layout.start)
    first = layout.start + struct.calcsize(layout.count)
    tags = {}
    for place in range(first, first + min(count, 4096) * layout.entry_bytes, layout.entry_bytes):
        tag, kind = struct.unpack_from(f"{layout.order}HH", head, place)
        if tag in {256, 257, 258, 277}:
            tags[tag] = _tiff_values(head, layout.order, kind, place + 4, is_big=layout.entry_bytes == 20)
    return _pixels(tags[256][0], tags[257][0], tags.get(277, [1])[0], -(-max(tags.get(258, [1])) // 8))


def _tiff_values(head: bytes, order: str, kind: int, place: int, *, is_big: bool) -> list[int]:
    code, room = {1: "B", 3: "H", 4: "I", 16: "Q"}[kind], 8 if is_big else 4
    wide = "Q" if is_big else "I"
    (count,) = struct.unpack_from(f"{order}{wide}", head, place)
    if not 1 <= count <= 64:
        raise ValueError("its header is cut off or damaged")
    value = place + room
    if count * struct.calcsize(f"{order}{code}") > room:
        (value,) = struct.unpack_from(f"{order}{wide}", head, value)
    return list(struct.unpack_from(f"{order}{count}{code}", head, value))


def exr_parts(head: bytes) -> list[dict[str, bytes]]:
    """Read the attributes of each part of an OpenEXR file, name -> value, from its first bytes.

    Raises:
        ValueError: the bytes are not those of an OpenEXR file, or are cut off. struct.error, IndexError: the header is
            cut off.
    """
    if head[:4] != b"\x76\x2f\x31\x01":
        raise ValueError("it is no OpenEXR image")
    (flags,) = struct.unpack_from("<I", head, 4)
    is_multipart, place, parts = bool(flags & 0x1000), 8, []
    while True:
        attributes, place = _exr_attributes(head, place)
        if not attributes:
            break
        parts.append(attributes)
        if not is_multipart:
            break
    if not parts:
        raise ValueError("its header is cut off or damaged")
    return parts


def _exr(head: bytes) -> Declared:
    parts = []
    for attributes in exr_parts(head):
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
        channels = _exr_channels(attributes["channels"])
        parts.append(_pixels(right - left + 1, bottom - top + 1, len(channels), max(channels, default=0)))
    return Declared("; ".join(part.size for part in parts[:4]), sum(part.decoded_bytes for part in parts))


def _exr_attributes(head: bytes, place: int) -> tuple[dict[str, bytes], int]:
    found = {}
    while head[place] != 0:
        end_of_name = head.index(0, place)
        name = head[place:end_of_name].decode("latin-1")
        place = head.index(0, end_of_name + 1) + 1  # past the attribute's type
        (length,) = struct.unpack_from("<i", head, place)
        if not 0 <= length <= len(head) - place - 4:
            raise ValueError("its header is cut off or damaged")
        found[name] = head[place + 4 : place + 4 + length]
        place += 4 + length
    return found, place + 1


def _exr_channels(value: bytes) -> list[int]:
    """Bytes per sample of each channel, from the attribute ``channels``."""
    place, widths = 0, []
    while value[place] != 0:
        place = value.index(0, place) + 1
        (kind,) = struct.unpack_from("<i", value, place)
        widths.append({0: 4, 1: 2, 2: 4}[kind])
        place += 16
    return widths


_READERS: Mapping[str, Callable[[bytes], Declared]] = MappingProxyType(
    {".npy": _npy, ".png": _png, ".tif": _tiff, ".tiff": _tiff, ".exr": _exr}
)
