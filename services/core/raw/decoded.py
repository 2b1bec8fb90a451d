"""The content of an image file, and the error of a file that holds something other than counts."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.errors import PlatformError

Numbers = NDArray[np.generic]


@dataclass(frozen=True)
class Decoded:
    """The content of an image file.

    Attributes:
        values: (H, W) or (H, W, C), uint8, uint16 or float32.
        names: names of the channels where the format has them: R, G, B, ...
        pattern: colours of the mosaic's 2 x 2 pixels at the upper left, row by row, where the format states them.
        white: count from which a pixel of the mosaic is full, for the 2 x 2 pixels of the pattern row by row, where
            the format states it.
        window: rows and columns of the image that the file holds (top, bottom, left, right; the ends are excluded);
            values outside it are 0. None for all.
    """

    values: Numbers
    names: tuple[str, ...] | None = None
    pattern: str | None = None
    white: tuple[float, ...] | None = None
    window: tuple[int, int, int, int] | None = None


class UnfitError(ValueError):
    """The file is intact, but holds something other than counts; the message is a part of a sentence."""


def of_extra(name: str) -> Any:
    """Import a library of the extra ``raw``.

    Raises:
        PlatformError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as problem:
        raise PlatformError(
            f"The package {name} is not installed; install dentine[raw] on this machine, or export PNG, TIFF or NPY"
            " files."
        ) from problem
