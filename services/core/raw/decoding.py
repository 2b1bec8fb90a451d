"""Read the numbers of an image file as they were written: no colour management, no scaling, no rotation.

Each library is imported by the function that needs it. Whole numbers come from PNG, TIFF, NPY and camera raw files,
single precision from EXR, TIFF and NPY. PNG is read by imagecodecs and TIFF by tifffile, because OpenCV returns a part
of a truncated PNG without an error.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import PlatformError

Numbers = NDArray[np.generic]
CAMERA_RAW = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".nef", ".orf", ".pef", ".raf", ".rw2", ".srw"}
)
"""Suffixes of the camera raw files that LibRaw reads."""
_SIGNATURES: Mapping[str, bytes] = MappingProxyType(
    {".png": b"\x89PNG\r\n\x1a\n", ".npy": b"\x93NUMPY", ".exr": b"v/1\x01"}
)
_JPEG = b"\xff\xd8\xff"
_LOSSY_TIFF = frozenset({6, 7, 34712, 34892, 50001, 50002})
"""Codes of the TIFF compressions that change counts: JPEG, JPEG 2000, lossy DNG, WebP, JPEG XL."""


@dataclass(frozen=True)
class Decoded:
    """The content of an image file.

    Attributes:
        values: (H, W) or (H, W, C), uint8, uint16 or float32.
        names: names of the channels where the format has them: R, G, B, ...
        pattern: colours of the mosaic's 2 x 2 pixels at the upper left, row by row, where the format states them.
    """

    values: Numbers
    names: tuple[str, ...] | None = None
    pattern: str | None = None


def decode(path: Path) -> Decoded:
    """Read an image file.

    Raises:
        ValueError: the file cannot be read; the message is the part of a sentence that says why.
        PlatformError: the extra ``raw`` is needed and absent.
    """
    suffix = path.suffix.lower()
    with path.open("rb") as stream:
        head = stream.read(16)
    if suffix in {".jpg", ".jpeg"} or head.startswith(_JPEG):
        raise ValueError(
            "is a JPEG, whose values are no counts; export the camera's raw file, or a PNG or TIFF of counts"
        )
    if suffix not in _DECODERS:
        known = ", ".join(sorted({*_DECODERS, "camera raw"} - CAMERA_RAW))
        raise ValueError(f"is of a format that is not read; export it as one of {known}")
    if not head:
        raise ValueError("is empty; copy it again")
    if not head.startswith(_SIGNATURES.get(suffix, b"")):
        raise ValueError(
            f"is no {suffix[1:].upper()} file inside; give it the suffix of what it is, or export it again"
        )
    try:
        return _DECODERS[suffix](path)
    except (PlatformError, _UnfitError):
        raise
    except MemoryError as problem:
        raise ValueError("is larger than the memory; crop or bin it") from problem
    except Exception as problem:  # each library has errors of its own, and a damaged file may raise any error
        reason = (str(problem) or type(problem).__name__).splitlines()[0].rstrip(".")
        raise ValueError(f"cannot be read ({reason}); it may be truncated, so copy or export it again") from problem


class _UnfitError(ValueError):
    """The file is intact, but holds something other than counts."""


def _png(path: Path) -> Decoded:
    import imagecodecs

    return Decoded(imagecodecs.png_decode(path.read_bytes()))


def _tiff(path: Path) -> Decoded:
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = file.pages.first
        if int(page.compression) in _LOSSY_TIFF:
            raise _UnfitError("is compressed with loss, so its values are no counts; export it without")
        values = page.asarray()
        if values.ndim == 3 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
            values = np.moveaxis(values, 0, -1)
    return Decoded(values)


def _npy(path: Path) -> Decoded:
    return Decoded(np.asarray(np.load(path, mmap_mode="r", allow_pickle=False)))


def _exr(path: Path) -> Decoded:
    library = _of_extra("OpenEXR")
    with library.File(str(path), separate_channels=True) as file:
        channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    names = tuple(sorted(name for name in channels if name != "A"))
    return Decoded(np.stack([channels[name].astype(np.float32) for name in names], axis=-1), names)


def _camera_raw(path: Path) -> Decoded:
    library = _of_extra("rawpy")
    with library.imread(str(path)) as raw:
        if raw.raw_type != library.RawType.Flat:
            raise _UnfitError("holds colours that the camera has mixed already; export the mosaic itself")
        values = np.array(raw.raw_image_visible)
        letters = raw.color_desc.decode()
        # Beside the visible area there may be a margin of odd width, so the pattern is that of the visible pixels.
        pattern = "".join(letters[k] for k in raw.raw_colors_visible[:2, :2].ravel())
    return Decoded(values, pattern=pattern)


def _of_extra(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as problem:
        raise PlatformError(
            f"The package {name} is not installed; install dentine[raw] on this machine, or export PNG, TIFF or NPY"
            " files."
        ) from problem


_DECODERS: Mapping[str, Callable[[Path], Decoded]] = MappingProxyType(
    {".png": _png, ".tif": _tiff, ".tiff": _tiff, ".npy": _npy, ".exr": _exr} | dict.fromkeys(CAMERA_RAW, _camera_raw)
)
