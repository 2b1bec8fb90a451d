"""Read .npy files without trusting their headers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError

MAX_FLOAT32 = float(np.finfo(np.float32).max)


def map_radiance(path: Path, shape: tuple[int, int, int], what: str) -> NDArray[np.floating[Any]]:
    """Map a .npy file of floating-point numbers, (height, width, channels).

    None of the pixels are read yet, whatever size the header declares.

    Args:
        shape: shape by the camera's description; a file of one channel may lack the last axis.
        what: the file and its meaning, in words with which an error message begins.

    Raises:
        CaptureInputError: the file cannot be read, or holds something else.
    """
    try:
        image = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as problem:
        # A malformed header can raise any kind of error: sizes beyond any integer, brackets without end.
        reason = str(problem) or type(problem).__name__
        raise CaptureInputError(
            f"{what} cannot be read as npy ({reason}); it may be truncated, so restore or export it again."
        ) from problem
    if not isinstance(image, np.ndarray) or not np.issubdtype(image.dtype, np.floating):
        raise CaptureInputError(f"{what} does not hold floating-point radiance; export linear values as float32.")
    if image.shape != shape and not (shape[2] == 1 and image.shape == shape[:2]):
        raise CaptureInputError(
            f"{what} has shape {image.shape} instead of {shape} (height, width, channels); export it at the camera's"
            " size."
        )
    return image.reshape(shape)


def as_float32(image: NDArray[np.floating[Any]], what: str) -> NDArray[np.float32]:
    """Read a mapped image into single precision.

    Raises:
        CaptureInputError: a finite value is too large for single precision.
    """
    with np.errstate(over="ignore"):
        single = np.array(image, dtype=np.float32)
    if image.dtype.itemsize > single.dtype.itemsize:
        too_large = np.isfinite(image) & ~np.isfinite(single)
        if too_large.any():
            largest = float(np.abs(image[too_large]).max())
            raise CaptureInputError(
                f"{what} holds {largest:.3g}, beyond single precision ({MAX_FLOAT32:.2g}); scale the radiance down."
            )
    return single
