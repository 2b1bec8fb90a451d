"""Masks drawn by hand as PNG files: what such a file must be, wherever it comes from.

A mask is plain grey of 1 or 8 bits a pixel, and its pixels that are not 0 are excluded. In pictures with a palette,
colours or transparency the ground may be white, black or transparent, so they are refused rather than guessed at.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from types import MappingProxyType

from services.core.files.image_headers import PNG_SIGNATURE, PngHeader, png_header

GREY = 0
_DEPTHS = (1, 8)
_PIECE_BYTES = 2**18
_OTHERS: Mapping[int, str] = MappingProxyType(
    {2: "colours", 3: "a palette", 4: "transparency", 6: "colours and transparency"}
)
"""Codes of the PNG colour types that are no masks."""


def require_mask_png(content: bytes, size: tuple[int, int]) -> None:
    """Require a complete plain grey PNG with 1 or 8 bits a pixel; no image is built.

    Args:
        size: width and height in pixels.

    Raises:
        ValueError: the content is something else; the message is a part of a sentence that says what.
    """
    try:
        _require_header(png_header(content), size)
        _require_rows(content, size)
    except struct.error as problem:
        raise ValueError("it is cut off") from problem
    except zlib.error as problem:
        raise ValueError(str(problem)) from problem


def _require_header(header: PngHeader, size: tuple[int, int]) -> None:
    if (header.width, header.height) != size:
        raise ValueError(f"it has {header.width} x {header.height} pixels")
    if header.colour != GREY:
        kind = _OTHERS.get(header.colour, f"the unknown colour type {header.colour}")
        raise ValueError(f"it has {kind}, so it is not plain grey of 1 or 8 bits a pixel")
    if header.depth not in _DEPTHS:
        raise ValueError(f"it has {header.depth} bits, so it is not plain grey of 1 or 8 bits a pixel")
    if header.is_interlaced:
        raise ValueError("it is interlaced, so it is not plain grey of 1 or 8 bits a pixel")


def _require_rows(content: bytes, size: tuple[int, int]) -> None:
    # Inflate in pieces and stop soon after the size that the header declares, as a mask may grow a thousandfold. Every
    # row begins with one byte, the number of its filter.
    (width, height), depth = size, png_header(content).depth
    expected_bytes = height * (1 + -(-width * depth // 8))
    inflater, inflated_bytes, place = zlib.decompressobj(), 0, len(PNG_SIGNATURE)
    while True:
        length, kind = struct.unpack_from(">I4s", content, place)
        data, (checksum,) = (
            content[place + 8 : place + 8 + length],
            struct.unpack_from(">I", content, place + 8 + length),
        )
        if zlib.crc32(kind + data) != checksum:
            raise ValueError("a part of it is damaged")
        if kind == b"tRNS":
            raise ValueError("it has transparency, so it is not plain grey of 1 or 8 bits a pixel")
        if kind == b"IDAT":
            is_used_up = inflater.eof
            while not is_used_up:
                piece = inflater.decompress(data, _PIECE_BYTES)
                inflated_bytes += len(piece)
                if inflated_bytes > expected_bytes:
                    raise ValueError("it holds more than its header declares")
                data, is_used_up = inflater.unconsumed_tail, len(piece) < _PIECE_BYTES
        if kind == b"IEND":
            break
        place += 12 + length
    if inflated_bytes != expected_bytes:
        raise ValueError("it holds less than its header declares")
