"""OpenEXR files of linear values: one part, one view, one size, square pixels, in the display window's coordinates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from services.core.raw.decoded import Decoded, UnfitError, of_extra

_LOSSLESS = frozenset({"NO_COMPRESSION", "RLE_COMPRESSION", "ZIPS_COMPRESSION", "ZIP_COMPRESSION", "PIZ_COMPRESSION"})
MAX_EXACT = 2**24
"""Largest whole number up to which single precision holds every whole number."""


def read_exr(path: Path) -> Decoded:
    """Read an OpenEXR file; pixels of the display window that the data window lacks are 0, outside of ``window``."""
    library = of_extra("OpenEXR")
    with library.File(str(path), separate_channels=True) as file:
        if len(file.parts) > 1:
            named = [str(part.header.get("name", k)) for k, part in enumerate(file.parts)]
            raise UnfitError(
                f"has {len(file.parts)} parts ({', '.join(named[:5])}), and which one is meant is not said; export one"
            )
        _require_plain(file.header())
        channels = {name: _pixels(name, channel) for name, channel in file.channels().items()}
        data, shown = (_box(file.header(), key) for key in ("dataWindow", "displayWindow"))
    if (alpha := channels.pop("A", None)) is not None and not np.all(alpha == 1):
        raise UnfitError("has an alpha channel that is not 1 everywhere; export it without transparency")
    if not channels:
        raise UnfitError("has no channel but alpha; export the picture itself")
    names = tuple(sorted(channels))
    values = np.stack([channels[name] for name in names], axis=-1)
    return _placed(values, names, data, shown)


def _require_plain(header: dict[str, Any]) -> None:
    if len(views := header.get("multiView") or ()) > 1:
        raise UnfitError(
            f"has several views ({', '.join(map(str, views))}), and which one is meant is not said; export one"
        )
    kind = getattr(header.get("type"), "name", "scanlineimage")
    if kind not in {"scanlineimage", "tiledimage"}:
        raise UnfitError(f"holds a {kind}, several values a pixel; export it flat")
    if (tiles := header.get("tiles")) is not None and (mode := tiles.mode.name) != "ONE_LEVEL":
        raise UnfitError(f"has its picture in several sizes ({mode}); export it without mip levels")
    if (aspect := float(header.get("pixelAspectRatio", 1.0))) != 1.0:
        raise UnfitError(f"has pixels {aspect:g} times as wide as high; export it with square pixels")
    if (method := header["compression"].name) not in _LOSSLESS:
        raise UnfitError(f"is compressed with loss ({method}), so its values are no counts; export it with ZIP")


def _pixels(name: str, channel: Any) -> np.ndarray:
    if (channel.xSampling, channel.ySampling) != (1, 1):
        raise UnfitError(f"has channel {name} at a smaller size than its picture; export it at full size")
    pixels = np.asarray(channel.pixels)
    if np.issubdtype(pixels.dtype, np.integer) and pixels.size and int(pixels.max()) > MAX_EXACT:
        raise UnfitError(f"has whole numbers up to {pixels.max()}, beyond single precision; export floating point")
    return pixels.astype(np.float32)


def _box(header: dict[str, Any], key: str) -> tuple[int, int, int, int]:
    """A window of the header: top, bottom, left, right, the ends excluded."""
    (left, top), (right, bottom) = ([int(one) for one in corner] for corner in header[key])
    if right < left or bottom < top:
        raise UnfitError(f"declares an empty {key}; export it again")
    return top, bottom + 1, left, right + 1


def _placed(
    values: np.ndarray, names: tuple[str, ...], data: tuple[int, int, int, int], shown: tuple[int, int, int, int]
) -> Decoded:
    if data == shown:
        return Decoded(values, names)
    top, bottom, left, right = data
    if values.shape[:2] != (bottom - top, right - left):
        raise UnfitError("holds another number of pixels than its data window; export it again")
    inside = max(top, shown[0]), min(bottom, shown[1]), max(left, shown[2]), min(right, shown[3])
    if inside[0] >= inside[1] or inside[2] >= inside[3]:
        raise UnfitError("has its pixels wholly outside of its display window; export it again")
    height, width = shown[1] - shown[0], shown[3] - shown[2]
    if height * width > 2**32:
        raise UnfitError(f"declares a display window of {width} x {height} pixels; export it again")
    whole = np.zeros((height, width, values.shape[2]), dtype=values.dtype)
    window = inside[0] - shown[0], inside[1] - shown[0], inside[2] - shown[2], inside[3] - shown[2]
    whole[window[0] : window[1], window[2] : window[3]] = values[
        inside[0] - top : inside[1] - top, inside[2] - left : inside[3] - left
    ]
    return Decoded(whole, names, window=None if window == (0, height, 0, width) else window)
