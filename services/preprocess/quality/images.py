"""Quality of prepared images, in numbers and small pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.core.geometry import Record
from services.core.records import MaskBit
from services.preprocess.views.source import Image, MotionSource

PICTURE_PX = 480
"""Longest side of a picture, pixels."""
STOPS = 10
"""Number of brightness classes below an image's brightest pixel, each one stop (a factor of two) wide. A sensor of 12
bits resolves the tenth."""
SHOWN_PIXELS = 200_000
"""Approximate number of an image's pixels from which its medians are computed."""
# Colours of masked pixels as (blue, green, red): highlights red, saturated yellow, moved violet, not finite cyan,
# shadow blue, manual green
COLOURS = {
    MaskBit.HIGHLIGHT: (60, 60, 230),
    MaskBit.SATURATED: (60, 220, 230),
    MaskBit.MOTION: (200, 60, 160),
    MaskBit.NOT_FINITE: (220, 200, 60),
    MaskBit.SHADOW: (200, 100, 40),
    MaskBit.MANUAL: (80, 180, 80),
}


class ImageQuality(Record):
    """Quality of one image."""

    camera: str
    light: str
    motion_px: float | None = Field(description="median displacement removed; null where not measured")
    motion_error_px: float | None = Field(
        default=None,
        description="standard error of either component of the motion, 0 where the subject is stated not to move; null"
        " in stores of earlier versions where it was not estimated",
    )
    motion_source: MotionSource | None = Field(
        default=None, description="what the motion is known from; null in stores of earlier versions"
    )
    tooth_pixels: int = Field(description="pixels whose whole footprint is to be fitted")
    valid_pixels: int
    valid_by_tooth: dict[int, int] = Field(default={}, description="FDI number -> valid pixels that show the tooth")
    masked: dict[str, float] = Field(description="mask bit -> fraction of the tooth pixels")
    levels: tuple[int, ...] = Field(description="tooth pixels with a value in each stop below the brightest of them")
    noise: tuple[float | None, ...] = Field(
        description="median standard deviation of a pixel, relative to it, in each stop; null where there is none"
    )


class CameraFlow(Record):
    """Optical flow over the teeth between a camera's first tracking frame and the one that moved most."""

    camera: str
    frame: int = Field(description="number of the frame that moved most")
    before_px: tuple[float, float] = Field(description="median and 95th percentile before the motion is taken out")
    after_px: tuple[float, float] = Field(description="the same afterwards, the flow's own errors among it")
    scale_px: float = Field(description="flow that the pictures show in full colour")


class QualityReport(Record):
    """``quality.json`` of a prepared store."""

    images: tuple[ImageQuality, ...]
    flows: tuple[CameraFlow, ...] = Field(default=(), description="of cameras whose motion was measured in one light")


def assess(
    camera: str,
    light: str,
    bits: NDArray[np.uint16],
    covered: NDArray[np.bool_],
    motion: tuple[float | None, float | None, MotionSource | None],
    stops: tuple[tuple[int, ...], tuple[float | None, ...]] = ((0,) * STOPS, (None,) * STOPS),
) -> ImageQuality:
    """Count the masked pixels among an image's tooth pixels.

    Args:
        bits: (H, W) mask bits; 0 is a valid pixel.
        covered: (H, W) tooth pixels.
        motion: median displacement over the teeth, its standard error, pixels, and what they are known from.
        stops: result of ``by_stop``.
    """
    pixels = int(np.count_nonzero(covered))
    # Count the pixels with each combination of bits
    counts = np.bincount(bits[covered], minlength=1)
    combinations = np.arange(len(counts))
    masked = {
        bit.name.lower(): float(counts[combinations & bit > 0].sum() / max(pixels, 1))
        for bit in MaskBit
        if bit.name is not None
    }
    return ImageQuality(
        camera=camera,
        light=light,
        motion_px=motion[0],
        motion_error_px=motion[1],
        motion_source=motion[2],
        tooth_pixels=pixels,
        valid_pixels=int(np.count_nonzero(bits == 0)),
        levels=stops[0],
        noise=stops[1],
        masked={name: share for name, share in masked.items() if share > 0},
    )


def by_stop(
    radiance: Image, variance: Image, chosen: NDArray[np.bool_]
) -> tuple[tuple[int, ...], tuple[float | None, ...]]:
    """Count the pixels in each stop below the brightest one, and find their median relative noise.

    Both use each pixel's mean over the channels. The darkest stop also counts everything below it.

    Args:
        radiance, variance: (H, W, C). chosen: (H, W) pixels that have a value.

    Returns:
        Counts (STOPS,), and median of standard deviation over value (STOPS,), None in an empty stop.
    """
    step = max(1, int(np.sqrt(chosen.size / SHOWN_PIXELS)))
    few = chosen[::step, ::step]
    value = radiance[::step, ::step][few].mean(axis=-1, dtype=np.float64)
    noise = np.sqrt(variance[::step, ::step][few].sum(axis=-1, dtype=np.float64)) / radiance.shape[-1]
    lit = value > 0
    if not lit.any():
        return (0,) * STOPS, (None,) * STOPS
    value, noise = value[lit], noise[lit]
    stop = np.minimum(np.log2(value.max() / value).astype(int), STOPS - 1)
    counts = np.bincount(stop, minlength=STOPS) * step**2
    medians = [float(np.median((noise / value)[stop == k])) if counts[k] else None for k in range(STOPS)]
    return tuple(counts.tolist()), tuple(medians)


def unusable_note(images: Sequence[ImageQuality]) -> tuple[str, ...]:
    """A sentence about pixels without a finite value or a positive variance; empty if there are none."""
    name = (MaskBit.NOT_FINITE.name or "").lower()
    counts = [round(image.masked.get(name, 0.0) * image.tooth_pixels) for image in images]
    if not any(counts):
        return ()
    worst = images[int(np.argmax(counts))]
    note = (
        f"{sum(counts)} pixels of teeth in {np.count_nonzero(counts)} images have no finite value or no positive"
        f" variance and are left out, most of them ({max(counts)}) in camera {worst.camera} under light {worst.light};"
        " export these images again if they should count."
    )
    return (note,)


def moved_note(images: Sequence[ImageQuality]) -> tuple[str, ...]:
    """A sentence about images that were moved by the outline of the teeth alone; empty if there are none."""
    moved = [image for image in images if image.motion_source == "outline" and (image.motion_px or 0) > 0]
    if not moved:
        return ()
    farthest = max(moved, key=lambda image: image.motion_px or 0)
    note = (
        f"The subject moved since the first image in {len(moved)} of {len(images)}, as the outline of the teeth lies"
        f" elsewhere there: most of all, by {farthest.motion_px:.1f} px, in camera {farthest.camera} under light"
        f" {farthest.light}; give motion = 'off' if it cannot have moved."
    )
    return (note,)


def write_picture(path: Path, radiance: Image, bits: NDArray[np.uint16]) -> None:
    """Write a PNG of the image, with masked tooth pixels in colour and everything beside the teeth dimmed."""
    import cv2

    step = max(1, -(-max(bits.shape) // PICTURE_PX))
    small, why = radiance[::step, ::step], bits[::step, ::step]
    grey = small[..., ::-1] if small.shape[-1] == 3 else np.repeat(small.mean(axis=-1, keepdims=True), 3, axis=-1)
    inside = why & np.uint16(MaskBit.OUTSIDE) == 0
    peak = float(np.quantile(grey[inside], 0.99)) if inside.any() else 1.0
    picture = 255 * np.clip(grey / max(peak, 1e-30), 0, 1) ** (1 / 2.2)
    picture[~inside] *= 0.4
    for bit, colour in COLOURS.items():
        picture[inside & (why & np.uint16(bit) > 0)] = colour
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), picture.astype(np.uint8))
