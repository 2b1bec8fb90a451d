"""Read the numbers of an image file as they were written: no colour management, no scaling, no rotation.

Each library is imported by the function that needs it. Whole numbers come from PNG, TIFF, NPY and camera raw files,
single precision from EXR, TIFF and NPY.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from services.core.errors import PlatformError
from services.core.raw.decoded import Decoded, UnfitError
from services.core.raw.exr_files import read_exr
from services.core.raw.picture_files import read_png, read_tiff
from services.core.raw.sensor_files import read_camera_raw

CAMERA_RAW = frozenset(
    {".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dng", ".erf", ".iiq", ".nef", ".orf", ".pef", ".raf", ".rw2", ".srw"}
)
"""Suffixes of the camera raw files that LibRaw reads."""
_SIGNATURES: Mapping[str, bytes] = MappingProxyType(
    {".png": b"\x89PNG\r\n\x1a\n", ".npy": b"\x93NUMPY", ".exr": b"v/1\x01"}
)
JPEG = frozenset({".jpg", ".jpeg"})
"""Suffixes of JPEG files, which may be photographs of boards, as those need no counts."""
_JPEG = b"\xff\xd8\xff"


def is_jpeg(path: Path) -> bool:
    """Whether a file is a JPEG by its name or by its first bytes."""
    if path.suffix.lower() in JPEG:
        return True
    with path.open("rb") as stream:
        return stream.read(len(_JPEG)) == _JPEG


def read_jpeg(path: Path) -> Decoded:
    """Read a JPEG as its sensor's rows and columns; its values are no counts, but show where things are.

    Raises:
        ValueError: the file cannot be read; the message is the part of a sentence that says why.
    """
    import imagecodecs

    try:
        return Decoded(np.asarray(imagecodecs.jpeg8_decode(path.read_bytes())))
    except Exception as problem:  # the library has errors of its own
        raise ValueError("cannot be read as a JPEG; it may be truncated, so copy or export it again") from problem


def decode(path: Path) -> Decoded:
    """Read an image file of counts.

    Raises:
        ValueError: the file cannot be read; the message is the part of a sentence that says why.
        PlatformError: the extra ``raw`` is needed and absent.
    """
    suffix = path.suffix.lower()
    with path.open("rb") as stream:
        head = stream.read(16)
    if suffix in JPEG or head.startswith(_JPEG):
        raise ValueError(
            "is a JPEG, whose values are no counts and which only a frame of kind board may be; export the camera's raw"
            " file, or a PNG or TIFF of counts"
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
    except (PlatformError, UnfitError):
        raise
    except MemoryError as problem:
        raise ValueError("is larger than the memory; crop or bin it") from problem
    except Exception as problem:  # each library has errors of its own, and a damaged file may raise any error
        reason = (str(problem) or type(problem).__name__).splitlines()[0].rstrip(".")
        raise ValueError(f"cannot be read ({reason}); it may be truncated, so copy or export it again") from problem


def _npy(path: Path) -> Decoded:
    values = np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
    return Decoded(values if values.dtype.isnative else values.astype(values.dtype.newbyteorder("=")))


_DECODERS: Mapping[str, Callable[[Path], Decoded]] = MappingProxyType(
    {".png": read_png, ".tif": read_tiff, ".tiff": read_tiff, ".npy": _npy, ".exr": read_exr}
    | dict.fromkeys(CAMERA_RAW, read_camera_raw)
)
