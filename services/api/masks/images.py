"""Masks as PNG: checks a mask that was sent without building an image, and encodes stored masks."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

from services.client.errors import MaskError
from services.core.files.image_headers import PNG_SIGNATURE, PngHeader, png_header
from services.core.geometry import Camera

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_GREY = 0
_DEPTHS = (1, 8)
_PIECE_BYTES = 2**18


def require_mask(content: bytes, camera: Camera) -> None:
    """Require a complete grey PNG of the camera's size with 1 or 8 bits a pixel.

    Raises:
        MaskError: the content is something else; the message says what is wrong.
    """
    try:
        _require_header(png_header(content), camera)
        _require_rows(content, camera)
    except (ValueError, struct.error, zlib.error) as problem:
        size, why = " x ".join(map(str, camera.size)), "it is cut off" if isinstance(problem, struct.error) else problem
        raise MaskError(
            f"The mask of camera {camera.name} cannot be used: {why}; send a grey PNG of {size} pixels."
        ) from problem


def _require_header(header: PngHeader, camera: Camera) -> None:
    if (header.width, header.height) != camera.size:
        raise ValueError(f"it has {header.width} x {header.height} pixels")
    if header.colour != _GREY or header.depth not in _DEPTHS or header.is_interlaced:
        raise ValueError("it is not plain grey of 1 or 8 bits a pixel")


def _require_rows(content: bytes, camera: Camera) -> None:
    # Inflate in pieces and stop soon after the size that the header declares, as a mask may grow a thousandfold. Every
    # row begins with one byte, the number of its filter.
    (width, height), depth = camera.size, png_header(content).depth
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


def picture_of(bits: NDArray[np.uint8]) -> bytes:
    """Encode an array of shape (height, width) as a grey PNG of 8 bits a pixel."""
    height, width = bits.shape
    rows = b"".join(b"\0" + row.tobytes() for row in bits)
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, _GREY, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    return PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )
