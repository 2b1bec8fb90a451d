"""Camera raw files: the counts of a Bayer mosaic, its pattern, and the counts at which it is full, by LibRaw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from services.core.raw.decoded import Decoded, UnfitError, of_extra
from services.core.raw.picture_files import bayer_pattern, filter_pattern

_LAYOUT = 50711
"""Tag of DNG for the arrangement of the mosaic's pixels; 1 is a rectangular one."""


def read_camera_raw(path: Path) -> Decoded:
    """Read the visible part of a camera raw file."""
    library = of_extra("rawpy")
    if path.suffix.lower() == ".dng":
        _require_bayer_tags(path)
    with library.imread(str(path)) as raw:
        if raw.raw_type != library.RawType.Flat:
            raise UnfitError("holds colours that the camera has mixed already; export the mosaic itself")
        if raw.raw_pattern is None:
            raise UnfitError("states no pattern of colour filters; export it as PNG, TIFF or NPY of one channel")
        values = np.array(raw.raw_image_visible)
        letters = np.array(list(raw.color_desc.decode()))
        # Beside the visible area there may be a margin of odd width, so the pattern is that of the visible pixels.
        colours = np.array(raw.raw_colors_visible)
        pattern = bayer_pattern(_filters(letters, colours))
        white = _white(raw, colours[:2, :2])
    if values.dtype.kind != "u":
        raise UnfitError(f"holds numbers of type {values.dtype}, which are no counts; export the camera's own file")
    return Decoded(values, pattern=pattern, white=white)


def _require_bayer_tags(path: Path) -> None:
    """Refuse a DNG whose tags state another mosaic; LibRaw takes planes of any colour for red, green and blue, and four
    rows for two.
    """
    import tifffile

    with tifffile.TiffFile(path) as file:
        pages = [page.aspage() for page in list(file.pages)]
        below = [inner.aspage() for page in pages for inner in page.pages or ()]
        for page in [*pages, *below]:
            filter_pattern(page)
            if (layout := page.tags.get(_LAYOUT)) is not None and layout.value != 1:
                raise UnfitError("has its pixels in staggered rows; export it as linear colours")


def _filters(letters: NDArray[np.str_], colours: NDArray[np.uint8]) -> NDArray[np.str_]:
    """Letters of a part of the mosaic that shows its whole repeat.

    Where the whole mosaic repeats after 2 x 2 pixels, as nearly all do, a few of them are enough.
    """
    height, width = (length // 2 * 2 for length in colours.shape)
    cut = colours[:height, :width]
    is_even = all(np.all(cut[y::2, x::2] == cut[y, x]) for y in range(2) for x in range(2))
    return letters[colours[:4, :4] if is_even else colours[:48, :48]]


def _white(raw: Any, colours: NDArray[np.uint8]) -> tuple[float, ...] | None:
    """Counts from which the pattern's four pixels are full; per channel where the file has several."""
    levels = np.full(4, float(raw.white_level or np.inf))
    if (by_channel := raw.camera_white_level_per_channel) is not None:
        own = np.array([float(one) if one else np.inf for one in by_channel][:4])
        levels[: len(own)] = np.minimum(levels[: len(own)], own)
    found = tuple(float(levels[one]) for one in colours.ravel())
    return found if all(np.isfinite(found)) else None
