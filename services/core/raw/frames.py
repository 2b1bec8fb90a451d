"""Read the counts of one frame of a raw folder, and check them against the camera's description in ``raw.toml``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.raw.decoded import Decoded
from services.core.raw.decoding import decode, is_jpeg, read_jpeg
from services.core.raw.folder import require_inside
from services.core.raw.fullness import Fullness, fullness_of
from services.core.raw.records import DARK, RawCamera, RawFolder, RawFrame

Counts = NDArray[np.uint16] | NDArray[np.float32]
_LETTERS = {"red": "R", "green": "G", "blue": "B"}
MAX_GREEN_RATIO = 4.0
"""Largest ratio of the difference between a mosaic's two green pixels to the difference between its red and blue ones.
Above it the mosaic is taken to begin with another colour."""
BRIGHT_PERCENT = 75
"""Percentile of brightness above which cells of 2 x 2 pixels are compared; the other cells may be black."""
MIN_CELLS = 32
"""Least number of cells to compare; with fewer, the pattern is not judged."""
MIN_GREEN_DIFFERENCE = 0.05
"""Half of the relative difference of a cell's green pixels up to which the pattern is not judged. The two greens of
real sensors differ by 1 or 2 %."""


@dataclass(frozen=True)
class Frame:
    """One photograph as it was read.

    Attributes:
        counts: (H, W) for a camera with a mosaic, else (H, W, C), in the order of the folder's channels; whole numbers
            as uint16 and others as float32. Of a JPEG of a board, its values (H, W, C) in its own order.
        fullness: from which count on its pixels are full.
    """

    counts: Counts
    fullness: Fullness


def read_counts(root: Path, folder: RawFolder, frame: RawFrame) -> Counts:
    """Read the counts of a frame; see ``read_frame``."""
    return read_frame(root, folder, frame).counts


def read_frame(root: Path, folder: RawFolder, frame: RawFrame) -> Frame:
    """Read the counts of a frame, and from which count on its pixels are full.

    Raises:
        CaptureInputError: the file does not fit; the message names it, its camera and light, and what is wrong.
        PlatformError: the extra ``raw`` is needed and absent.
    """
    what = f"Frame {root / frame.file} ({frame.label})"
    path = require_inside(root, frame.file, what)
    camera = folder.camera_named(frame.camera)
    try:
        if frame.kind == "board" and is_jpeg(path):
            return _picture(read_jpeg(path), camera)
        decoded = decode(path)
        _require_whole(decoded, frame, camera)
        counts = _significant_bits(_in_camera_shape(decoded, camera), camera)
        _require_pattern(decoded, counts, camera)
    except OSError as problem:
        raise CaptureInputError(
            f"{what} cannot be opened ({problem.strerror}); check the disk and its permissions."
        ) from problem
    except ValueError as problem:
        raise CaptureInputError(f"{what} {problem}.") from problem
    if camera.mosaic == "none":
        order = [camera.channels.index(channel) for channel in folder.channels]
        if order != sorted(order):
            counts[:] = counts[..., order]
    return Frame(counts, _fullness(decoded, counts, frame, camera))


def _picture(decoded: Decoded, camera: RawCamera) -> Frame:
    # A JPEG of a board: of the camera's size, with any number of channels and 8 bits whatever the camera's counts have.
    values = decoded.values
    _require_size(values, camera)
    values = values[..., None] if values.ndim == 2 else values
    return Frame(values.astype(np.uint16), Fullness((np.inf,) * values.shape[2], values.shape[:2], False))


def _require_size(values: NDArray[np.generic], camera: RawCamera) -> None:
    width, height = camera.size
    if values.ndim not in {2, 3} or values.shape[:2] != (height, width):
        size = " x ".join(map(str, (values.shape[1::-1] if values.ndim in {2, 3} else values.shape)))
        turned = " (turned by 90 degrees?)" if values.shape[:2] == (width, height) else ""
        raise ValueError(
            f"has {size} pixels{turned}, but its camera has {width} x {height}; export it at the camera's size"
        )


def _require_whole(decoded: Decoded, frame: RawFrame, camera: RawCamera) -> None:
    if decoded.window is not None and (frame.kind in DARK or camera.mosaic != "none"):
        raise ValueError("holds a part of its picture only; export it whole")


def _fullness(decoded: Decoded, counts: Counts, frame: RawFrame, camera: RawCamera) -> Fullness:
    if frame.kind in DARK:
        sites = 4 if camera.mosaic != "none" else counts.shape[2]
        stated = np.inf if camera.full_counts is None else camera.full_counts
        return Fullness((stated,) * sites, counts.shape[:2], camera.mosaic != "none")
    white = None if decoded.white is None else [level / 2**camera.shift for level in decoded.white]
    return fullness_of(counts, camera, white, decoded.window)


def _in_camera_shape(decoded: Decoded, camera: RawCamera) -> NDArray[np.generic]:
    """The file's values in the shape of the camera, (H, W) or (H, W, C), with channels in the camera's order."""
    values, names = decoded.values, decoded.names
    if names is not None and len(names) == len(camera.channels) and camera.mosaic == "none":
        letters = [_LETTERS.get(channel, channel) for channel in camera.channels]
        if len(names) > 1 and set(names) != set(letters):
            raise ValueError(
                f"has channels {', '.join(names)}, but its camera has {', '.join(camera.channels)}; rename them"
            )
        values = values[..., [names.index(letter) for letter in letters]] if len(names) > 1 else values
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    _require_size(values, camera)
    width, height = camera.size
    in_file = 1 if values.ndim == 2 else values.shape[2]
    if camera.mosaic != "none" and in_file != 1:
        raise ValueError(f'has {in_file} channels, but its camera\'s files hold a mosaic of one; set mosaic = "none"')
    if camera.mosaic == "none" and in_file != len(camera.channels):
        raise ValueError(
            'has one number a pixel, but its camera is described with colours; give the camera channels = ["grey"], or'
            " its mosaic where its pixels lie behind colour filters"
            if in_file == 1
            else f"has {in_file} channels, but its camera has {len(camera.channels)}; correct the camera's channels, or"
            " export it again"
        )
    return values if camera.mosaic != "none" else values.reshape(height, width, in_file)


def _significant_bits(values: NDArray[np.generic], camera: RawCamera) -> Counts:
    """Counts without the unused low bits of the file (``shift``), checked against the camera's depth."""
    if np.issubdtype(values.dtype, np.floating) and values.dtype.itemsize <= 4:
        numbers = np.array(values, dtype=np.float32)
        if non_finite := int(np.count_nonzero(~np.isfinite(numbers))):
            raise ValueError(f"has {non_finite} values that are no finite numbers; export it again")
        return numbers
    if values.dtype not in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        raise ValueError(
            f"holds numbers of type {values.dtype}; export whole numbers of 8 or 16 bits, or single precision"
        )
    if camera.bits is None:
        raise ValueError("holds whole numbers, and how many of their bits count is not said; give the camera its bits")
    file_bits = 8 * values.dtype.itemsize
    if camera.bits + camera.shift > file_bits:
        raise ValueError(
            f"has {file_bits} bits a count, but its camera has"
            f" {camera.bits}{f' moved up by {camera.shift}' if camera.shift else ''}; export it at the camera's depth,"
            " or correct bits and shift"
        )
    counts = values.astype(np.uint16) >> np.uint16(camera.shift)
    most = int(counts.max())
    if most >= 2**camera.bits:
        raise ValueError(
            f"holds a count of {most}, more than the {camera.bits} bits of its camera; correct bits, "
            "or set shift where they lie in the high bits"
        )
    return counts


def _require_pattern(decoded: Decoded, counts: Counts, camera: RawCamera) -> None:
    """Refuse a mosaic that starts at another colour than the camera's."""
    if camera.mosaic == "none":
        if decoded.pattern is not None:
            raise ValueError(f"is a mosaic that begins {decoded.pattern}, but its camera has none; set mosaic")
        return
    if decoded.pattern is not None and decoded.pattern != camera.mosaic:
        raise ValueError(
            f"is a mosaic that begins {decoded.pattern}, but its camera's begins {camera.mosaic}; correct mosaic"
        )
    if min(counts.shape) < 2:
        raise ValueError("is too small to hold a mosaic; correct mosaic")
    # Both green pixels of a cell see the same light. Where they differ in most cells and the other two agree, the
    # pattern begins one pixel further.
    height, width = (length // 2 * 2 for length in counts.shape)
    cells = [counts[k // 2 : height : 2, k % 2 : width : 2].astype(np.float32) for k in range(4)]
    bright = sum(cells) >= np.percentile(sum(cells), BRIGHT_PERCENT)
    greens, others = (
        [cell[bright] for cell, letter in zip(cells, camera.mosaic, strict=True) if (letter == "G") == is_green]
        for is_green in (True, False)
    )
    # Medians are compared, because edges in the image make single cells differ in either direction.
    deviation, expected = (abs(float(np.median((a - b) / np.maximum(a + b, 1)))) for a, b in (greens, others))
    if len(greens[0]) >= MIN_CELLS and deviation > MAX_GREEN_RATIO * expected and deviation > MIN_GREEN_DIFFERENCE:
        remedy = "correct mosaic" if decoded.pattern is None else "the file states a wrong pattern, so export it again"
        raise ValueError(
            f"has green pixels that differ by {2 * deviation:.0%}, so it does not begin {camera.mosaic}; {remedy}"
        )
