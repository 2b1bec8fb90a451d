"""Masks as PNG: checks a mask that was sent, and encodes stored masks."""

from __future__ import annotations

import struct
import zlib
from typing import TYPE_CHECKING

from services.client.errors import MaskError
from services.core.files.image_headers import PNG_SIGNATURE
from services.core.files.mask_images import GREY, require_mask_png
from services.core.geometry import Camera

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def require_mask(content: bytes, camera: Camera) -> None:
    """Require a mask of the camera's size; see ``mask_images``.

    Raises:
        MaskError: the content is something else; the message says what is wrong.
    """
    try:
        require_mask_png(content, camera.size)
    except ValueError as problem:
        size = " x ".join(map(str, camera.size))
        raise MaskError(
            f"The mask of camera {camera.name} cannot be used: {problem}; send a grey PNG of {size} pixels."
        ) from problem


def picture_of(bits: NDArray[np.uint8]) -> bytes:
    """Encode an array of shape (height, width) as a grey PNG of 8 bits a pixel."""
    height, width = bits.shape
    rows = b"".join(b"\0" + row.tobytes() for row in bits)
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, GREY, 0, 0, 0)),
        (b"IDAT", zlib.compress(rows)),
        (b"IEND", b""),
    )
    return PNG_SIGNATURE + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in parts
    )
