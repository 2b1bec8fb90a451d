"""Checks of a raw folder's frames against each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.core.errors import CaptureInputError
from services.core.raw.merge import Exposure
from services.core.raw.records import RawFolder, RawFrame
from services.preprocess.views.colours import FrameColour

Image = NDArray[np.float32]

MAX_EXPOSURE_FACTOR = 1.5
"""Largest factor by which a frame may be brighter or darker than expected from another exposure of its light."""
CLIP_SHARE = 0.8
"""Fraction of full scale at which counts are clipped for this comparison, because sensors are not linear above it."""
MIN_MEAN_SHARE = 0.01
"""Smallest mean, as a fraction of full scale, of a frame that is compared; a darker one does not show its exposure."""
COUNTED = 3.0
"""Smallest mean of a block above black, in counts, that counts as light. Black that is cut at zero leaves a mean of
half the noise, and rounding is half a count."""
COUNTED_SHARE = 0.012
"""The same as a fraction of full scale, for files whose full scale is small: 3 counts of 8 bits."""
COUNTED_BLOCK = 8
"""Side in pixels of such a block."""
SURELY_COUNTED = 2.0
"""Factor above ``COUNTED`` at which a frame should have counted the light that another one tells."""
MIN_CONTRAST = 0.2
"""Smallest ratio of a picture's standard deviation to its mean at which it is compared with another exposure."""
MIN_CORRELATION = 0.5
"""Smallest correlation of two exposures of the same scene. Noise of 12 bits leaves 0.9, and a tooth that moved by a
tenth of its width 0.7."""


def missing_exposures(folder: RawFolder) -> Iterator[str]:
    """Yield a sentence for each camera and light that lacks an exposure which most of the camera's lights have."""
    for camera in folder.camera:
        exposures: dict[str, set[float]] = {}
        for frame in folder.frames_of(camera.name, "light"):
            exposures.setdefault(str(frame.light), set()).add(frame.exposure_s * frame.gain)
        usual = set.union(*exposures.values()) if exposures else set()
        for light, own in exposures.items():
            missing = sorted(
                value for value in usual - own if sum(value in one for one in exposures.values()) > len(exposures) / 2
            )
            if missing:
                files = ", ".join(one.file for one in folder.frames_of(camera.name, "light") if one.light == light)
                yield (
                    f"Camera {camera.name}, light {light} lacks the exposure of {missing[0]:g} s that most lights have;"
                    f" its frames are {files}."
                )


def colour_of(frame: RawFrame, channels: tuple[str, ...], radiance: NDArray[np.float32]) -> FrameColour | None:
    """Ratio of red to blue of a frame's pixels (N, C), in the order of ``channels``; None if it is undefined."""
    if not {"red", "blue"} <= set(channels) or not radiance.size:
        return None
    red, blue = (float(np.abs(radiance[..., channels.index(one)]).mean(dtype=np.float64)) for one in ("red", "blue"))
    if min(red, blue) <= 0:
        return None
    return FrameColour(file=frame.file, label=frame.label, log_red_to_blue=float(np.log(red / blue)))


def require_like_exposures(
    root: Path, frames: Sequence[RawFrame], exposures: Sequence[Exposure], channels: tuple[str, ...]
) -> list[RawFrame]:
    """Refuse exposures of one light that contradict each other in any channel. They are compared only where both
    counted light.

    Args:
        root: the raw folder.
        frames: frames of the light.
        exposures: exposures of the frames, (H, W) of a mosaic or (H, W, C) in the order of ``channels``.
        channels: names of the channels.

    Returns:
        Frames whose exposure is too short to count anything.

    Raises:
        CaptureInputError: two exposures contradict each other; the message names the longer exposure's frame, or the
            one that is empty.
    """
    empty: list[RawFrame] = []
    order = sorted(zip(frames, exposures, strict=True), key=lambda one: one[1].factor)
    for (shorter, first), (longer, second) in pairwise(order):
        what = f"Frame {root / longer.file} ({longer.label})"
        if _is_empty(root, (shorter, longer), (first, second)):
            empty.append(shorter)
            continue
        log_ratio = _log_brightness_ratio(first, second.signal, second.headroom, second.factor)
        if log_ratio is None:
            continue
        if np.abs(log_ratio).max() < np.log(MAX_EXPOSURE_FACTOR):
            if not _is_correlated(first, second):
                raise CaptureInputError(
                    f"{what} shows another picture than {shorter.file}; exchange its bytes, or correct its light or"
                    " place."
                )
            continue
        if first.signal.ndim == 3 and {"red", "blue"} <= set(channels):
            swap = np.arange(len(channels))
            red, blue = channels.index("red"), channels.index("blue")
            swap[[red, blue]] = blue, red
            swapped_log_ratio = _log_brightness_ratio(
                first, second.signal[..., swap], second.headroom[..., swap], second.factor
            )
            if swapped_log_ratio is not None and np.abs(swapped_log_ratio).max() < np.log(MAX_EXPOSURE_FACTOR) / 2:
                raise CaptureInputError(
                    f"{what} has red and blue exchanged against {shorter.file}; export both with the same order of"
                    " channels."
                )
        found = "brighter" if log_ratio[np.argmax(np.abs(log_ratio))] > 0 else "darker"
        raise CaptureInputError(
            f"{what} is clearly {found} than {shorter.file} lets expect from exposure_s, gain and level; correct these,"
            " or the order of its bytes, bits or channels."
        )
    return empty


def _is_empty(root: Path, frames: tuple[RawFrame, RawFrame], exposures: tuple[Exposure, Exposure]) -> bool:
    """Whether the shorter one of two exposures counts nothing, because it is too short.

    Raises:
        CaptureInputError: an exposure counts nothing where the other one tells that it should.
    """
    first, second = exposures
    least = _least_counts(first)
    blocks = [_block_means(one.signal) for one in exposures]
    expected = [blocks[1] * first.factor / second.factor, blocks[0] * second.factor / first.factor]
    for own, predicted, frame, other in zip(blocks, expected, frames, reversed(frames), strict=True):
        if own.max() < least and predicted.max() >= SURELY_COUNTED * least:
            raise CaptureInputError(
                f"Frame {root / frame.file} ({frame.label}) is empty: it counts nothing above its black, where"
                f" {other.file} lets expect {predicted.max():.3g} counts; take it again with the light on, or correct"
                " its kind, exposure_s, gain or level."
            )
    return bool(blocks[0].max() < least)


def _least_counts(exposure: Exposure) -> float:
    full = float(np.max(exposure.headroom + exposure.signal))
    return min(COUNTED, COUNTED_SHARE * full) if np.isfinite(full) else COUNTED


def _block_means(signal: Image) -> NDArray[np.float64]:
    """Means of blocks of an image, (h, w, C)."""
    image = np.atleast_3d(signal)
    side = max(1, min(COUNTED_BLOCK, *image.shape[:2]))
    height, width = (length // side for length in image.shape[:2])
    cut = image[: height * side, : width * side].reshape(height, side, width, side, -1)
    return np.asarray(cut.mean(axis=(1, 3), dtype=np.float64))


def _log_brightness_ratio(first: Exposure, signal: Image, headroom: Image, factor: float) -> NDArray[np.float64] | None:
    """Logarithm (C,) of the ratio of a longer exposure's mean to the mean expected from a shorter one, by channel.

    It is None if the frames are too dark or full scale is unknown. Blocks where one of them counts nothing are left
    out, because black that is cut at zero would look like light there. Both exposures are clipped below full scale, so
    that pixels which are saturated in the longer one, or would be, agree.

    Args:
        first: the shorter exposure.
        signal, headroom, factor: signal, headroom and exposure factor of the longer one.
    """
    full = float(np.max(headroom + signal))
    if not np.isfinite(full):
        return None
    clip_counts = np.float32(CLIP_SHARE * full)
    expected = np.minimum(first.signal * np.float32(factor / first.factor), clip_counts)
    predicted, seen = _block_means(expected), _block_means(np.minimum(signal, clip_counts))
    if min(one.mean(axis=(0, 1)).min() for one in (predicted, seen)) < MIN_MEAN_SHARE * full:
        return None
    least = _least_counts(first)
    counted = (_block_means(first.signal) >= least) & (_block_means(signal) >= least)
    if not counted.any(axis=(0, 1)).all():
        return None
    return np.asarray(np.log((seen * counted).sum(axis=(0, 1)) / (predicted * counted).sum(axis=(0, 1))))


def _is_correlated(first: Exposure, second: Exposure) -> bool:
    """Whether two exposures correlate in every channel; channels without contrast are not compared."""
    unsaturated = (first.headroom > 0) & (second.headroom > 0)
    planes = [np.moveaxis(np.atleast_3d(image), -1, 0) for image in (first.signal, second.signal, unsaturated)]
    for a, b, usable in zip(*planes, strict=True):
        shorter, longer = a[usable.astype(bool)].astype(np.float64), b[usable.astype(bool)].astype(np.float64)
        if shorter.size < 2 or shorter.std() < MIN_CONTRAST * abs(shorter.mean()) or longer.std() == 0:
            continue
        if np.corrcoef(shorter, longer)[0, 1] < MIN_CORRELATION:
            return False
    return True
