"""Images with personal metadata: a place, a name, serial numbers."""

from __future__ import annotations

import struct
import zlib
from io import BytesIO
from typing import Any

import pytest

Image = pytest.importorskip("PIL.Image", reason="Pillow comes with the extra fit")
PngInfo = pytest.importorskip("PIL.PngImagePlugin").PngInfo
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description exif:GPSLatitude="52,31.2N"'
    ' aux:SerialNumber="0123456"/></x:xmpmeta>'
)
CAMERA, GPS, BODY_SERIAL, MAKE = 0x8769, 0x8825, 0xA431, 0x010F


def exif() -> Any:
    """Exif data with a maker, the camera's serial number and a place."""
    tags = Image.Exif()
    tags[MAKE] = "Maker"
    tags.get_ifd(CAMERA)[BODY_SERIAL] = "0123456"
    tags.get_ifd(GPS).update({1: "N", 2: (52.0, 31.0, 12.0)})
    read = Image.Exif()
    read.load(tags.tobytes())
    return read


def written(suffix: str, mode: str = "RGB", **options: Any) -> bytes:
    stream = BytesIO()
    Image.new(mode, (7, 5)).save(stream, format={".png": "PNG", ".tif": "TIFF"}[suffix], **options)
    return stream.getvalue()


def told_png() -> bytes:
    info = PngInfo()
    info.add_itxt("XML:com.adobe.xmp", XMP)
    info.add_text("Author", "A name")
    return written(".png", exif=exif(), pnginfo=info)


def with_text(png: bytes, text: bytes) -> bytes:
    """Insert a text chunk after a PNG's header."""
    text_part = struct.pack(">I4s", len(text), b"tEXt") + text + struct.pack(">I", zlib.crc32(b"tEXt" + text))
    return png[:33] + text_part + png[33:]
